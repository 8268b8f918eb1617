"""Errors of a run's network before its first step and at its end, and of the mean colour, on what is held out."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from photonfarm.store import SceneReader
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.predictors.evaluation import make_network_predictor, measure, read_batches
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.report.data_and_runs import Baselines
from photonfarm.trainer.runs.settings import MOST_HELD_OUT


@dataclass(frozen=True)
class Errors:
    first: float
    last: float
    mean_colour: float
    configurations: int


def held_out_errors(make: Callable[[], SceneReader], folder: Path) -> Errors:
    """The held-out errors of a run; `make` gives its source anew, as each is read once."""
    run = TrainedRun.load(folder)
    with Feed(make(), run.settings.model_copy(update={"device": "cpu"}), needs=run.needs) as feed:
        rows = [row for row, held in feed.arrivals()[0] if held][:MOST_HELD_OUT]
        baselines = Baselines.of(make(), run, rows)
        network = run.network(feed.spec, feed.base)
        last = measure(make_network_predictor(network), read_batches(feed, rows, run.settings.batch)).error
    return Errors(baselines.untrained.error.mean, last.mean, baselines.mean_colour.error.mean, last.count)
