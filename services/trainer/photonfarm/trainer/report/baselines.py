"""Baselines for errors: the mean colour, and the network before its first step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from photonfarm.shared.core.errors import IncompleteError
from photonfarm.trainer.data.feed import Feed, SampleSource
from photonfarm.trainer.predict.evaluation import (
    HeldOutErrors,
    batches,
    constant_predictor,
    mean_colours,
    measure,
    network_predictor,
)
from photonfarm.trainer.predict.trained import TrainedRun
from photonfarm.trainer.runs.run_folder import INITIAL

MOST_TRAINING = 1024  # samples to take the mean colour of


@dataclass(frozen=True, slots=True, eq=False)
class Baselines:
    """Errors to compare with, in linear radiance × exposure, the targets' noise removed."""

    mean_colour: HeldOutErrors  # of the training samples, everywhere
    mean_shown_colour: HeldOutErrors  # the same of these samples with light above white cut, for `shown` alone
    untrained: HeldOutErrors  # the first run's network before its first step

    @classmethod
    def of(cls, source: SampleSource, run: TrainedRun, rows: Sequence[int]) -> Baselines:
        """Measure them on some held-out samples of a run; raises IncompleteError without samples for the colour."""
        settings = run.settings.model_copy(update={"device": "cpu"})
        with Feed(source, settings, needs=run.needs) as feed:
            arrived, _ = feed.arrivals()
            training = [row for row, held in arrived if not held]
            if not training:
                raise IncompleteError("no training sample is complete, and a report compares with their mean colour")
            some = training[:: -(-len(training) // MOST_TRAINING)]
            colour, shown_colour = mean_colours(batches(feed, some, settings.batch))
            network = TrainedRun.load(run.folder, INITIAL).network(feed.spec, (feed.geometry, feed.cloud))
            return cls(
                measure(constant_predictor(colour), batches(feed, rows, settings.batch)),
                measure(constant_predictor(shown_colour), batches(feed, rows, settings.batch)),
                measure(network_predictor(network), batches(feed, rows, settings.batch)),
            )
