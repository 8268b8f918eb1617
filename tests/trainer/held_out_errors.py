"""Errors of a run's network before its first step and at its end, and of the mean colour, on what is held out."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from photonfarm.plan.hold_out import rows_held_out
from photonfarm.store import SceneReader
from photonfarm.trainer.predictors.evaluation import make_network_predictor, measure_together, read_in_turn
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.report.data_and_runs import Baselines, make_baselines
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
    source = make()
    complete = source.refresh().tolist()
    held_out = rows_held_out(source, complete, run.settings.hold_out)
    rows = [row for row, held in zip(complete, held_out, strict=True) if held][:MOST_HELD_OUT]
    last_of = make_network_predictor(run.network(source.spec, source.base()))
    batches = read_in_turn(source, rows, run.settings.batch, run.needs, run.settings.network.points)
    errors = measure_together([last_of, *make_baselines(source, run, "cpu")], batches)
    last, baselines = errors[0].error, Baselines("", *errors[1:])
    return Errors(baselines.untrained.error.mean, last.mean, baselines.mean_colour.error.mean, last.count)
