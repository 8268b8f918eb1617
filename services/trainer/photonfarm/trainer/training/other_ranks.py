"""The other processes of a group while rank 0 trains: they compute their part of each batch, at its commands.

A trainer is announced in its scene while it reads there, and ends that for whoever takes the scene's lease.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import torch

from photonfarm.core.processes import Stop
from photonfarm.core.waiting import pause_after_look
from photonfarm.store import SceneReader
from photonfarm.store.model.lease import LeasedError
from photonfarm.trainer.data.batch import ResidentSamples
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.predictors.half_filter import choose_filter, settle_filter
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.devices import Ranks
from photonfarm.trainer.runs.run_folder import CHECKPOINT
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.good_state import GoodState
from photonfarm.trainer.training.learner import Learner, name_compile_errors
from photonfarm.trainer.training.start_from import start_from


def assist(source: Callable[[str, float], SceneReader], settings: TrainSettings, run: Path, ranks: Ranks) -> None:
    """Train with rank 0 until that ends; `source` makes the samples of a scene, given its id and its exposure.

    A resumed run is read from the folder `run`, which rank 0 writes. Raises what `train` does.
    """
    settings = settle_filter(settings, run)
    torch.set_num_threads(settings.threads)
    command, value = ranks.receive()
    if command == "end":
        return
    own = settings.model_copy(update={"batch": -(-settings.batch // ranks.size)})
    resident = ResidentSamples(ranks.device(settings.device), settings.resident_gb)
    samples, finish = source(value["scene_id"], value["exposure"]), choose_filter(settings, run)
    with Feed(samples, own, resident=resident, finish=finish) as feed:
        frame = SceneFrame.of(feed.spec, *feed.base, settings.network)
        learner, step = Learner(frame, settings, ranks), value["step"]
        good = GoodState(learner, settings)
        if value["continues"]:
            good.restore(checkpoint.load(run / CHECKPOINT), run)
        elif settings.start_from:
            start_from(learner, value["scene_id"], settings)
        with name_compile_errors(settings.compile):
            while (received := ranks.receive())[0] != "end":
                command, value = received
                if command == "rows":
                    feed.ask(ranks.part(value))
                elif command == "take":
                    good.take_step(step, feed.take())
                    step += 1
                elif command == "last":
                    learner.last_step = value
                elif command == "keep":
                    good.keep(value)
                elif command == "back":
                    good.go_back(value)
                else:  # "quiet"
                    with feed.quiet():
                        ranks.meet()
                        if ranks.receive()[0] == "end":  # or "on"
                            return


LOOK_S = 2.0
"""The seconds between two looks for a lease, or more where a look takes long."""


class Presence:
    """A context manager: at its end the trainer is no longer at work in the scene."""

    def __init__(self, source: SceneReader, what: str, tell: Callable[[str], object]) -> None:
        """Nothing is announced yet. `tell` gets a sentence when somebody else has the scene for itself."""
        self._source, self._what, self._tell = source, what, tell
        self._announced = ExitStack()
        self._due = 0.0
        self.is_there = False  # announced as at work

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def begin(self, stop: Stop, is_over: Callable[[], bool]) -> bool:
        """Announce it as soon as nobody has the scene for itself; False if it is stopped or over before that."""
        said = ""
        while not self.is_there:
            try:
                self._announced.enter_context(self._source.at_work(self._what))
                self.is_there = True
            except LeasedError as error:
                if str(error) != said:
                    self._tell(f"training waits: {error}")
                said = str(error)
                if stop.wait(LOOK_S) or is_over():
                    break
        return self.is_there

    def end(self) -> None:
        """End it: whoever has the lease may begin."""
        self._announced.close()
        self.is_there = False

    def is_to_end(self) -> bool:
        """Whether somebody has taken the lease, by a look now and then."""
        if (began := time.monotonic()) < self._due:
            return False
        is_leased = self._source.lease() is not None
        self._due = (now := time.monotonic()) + pause_after_look(now - began, LOOK_S)
        return is_leased
