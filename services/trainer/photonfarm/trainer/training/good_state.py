"""The good states of a learner that a run goes back to: a validated one, and a snapshot of shortly before."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from photonfarm.core.errors import store_errors
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import name_misfit
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import GOOD
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.learner import DivergedError, Learner
from photonfarm.trainer.training.recent_losses import FEW, LOOK_EVERY, Judgement, RecentLosses, judge

NEXT = "good.next.safetensors"  # in the run's folder too, until the checkpoint that refers to it is written
WITHOUT = "remove it, and the run goes on, with nothing to go back to before its next good validation"

MOST = 8
"""How often a run may go back: by then the rate is 1/256, and it diverges for another reason."""

FACTOR = 0.5
"""The factor on the rate each time."""


SNAPSHOT_EVERY = 50
"""The steps between two snapshots, at least."""


@dataclass(frozen=True, slots=True)
class Setback:
    """A return to a snapshot, because of the losses."""

    back_to: int  # step
    now: float  # as in a `Judgement`
    usual: float


class GoodState:
    """The good states of a learner to go back to, equal in all processes of a group: a validated one, and a snapshot.

    The validated one outlasts the run, in a file. The snapshot is a few dozen steps old, and in the device's memory.
    """

    def __init__(self, learner: Learner, settings: TrainSettings) -> None:
        self._learner, self._settings = learner, settings
        self._kept: dict[str, Any] = {}  # in memory of its own
        self._is_new = False  # not in any file yet
        self.step: int | None = None  # at which it was kept; None if nothing is
        self.recoveries = 0
        self._losses, self._untrained = RecentLosses(), RecentLosses()
        self._first_network: Network | None = None  # as it was before any step
        self._snapshot: dict[str, Any] | None = None  # `step`, `losses`, and the `learner`'s state

    def keep(self, step: int, rest: Mapping[str, Any] | None = None) -> None:
        """Keep the learner's state at a step, and the rest of a checkpoint, which makes its file one."""
        state = _copy({**self._learner.state(), **(rest or {})}, torch.device("cpu"))
        self._kept, self.step, self._is_new = state, step, True

    def take_step(self, number: int, batch: TrainingBatch) -> Setback | None:
        """Take a step; every few steps look at the losses, and if they say that the run diverges, go back.

        Raises DivergedError as `go_back` does, and without `recover` for a loss that is not finite.
        """
        if self._settings.recover and self._snapshot is None:
            self._take_snapshot(number)
        if self._settings.recover:
            self._add_untrained_loss(number, batch)
        self._losses.add(self._learner.step(number, batch))
        done = number + 1
        if done % LOOK_EVERY and done % self._settings.checkpoint_every:
            return None
        judgement = judge(self._losses.read(), self._untrained.read())
        if self._snapshot is None:
            if not math.isfinite(judgement.now):
                raise DivergedError(f"step {done}: {judgement.sentence}")
        elif judgement.is_diverging:
            return self._go_back_to(self._snapshot, f"step {done}: {judgement.sentence}", judgement)
        elif judgement.is_calm and done - self._snapshot["step"] >= SNAPSHOT_EVERY:
            self._take_snapshot(done)
        return None

    def _add_untrained_loss(self, number: int, batch: TrainingBatch) -> None:
        """Add, during the first steps, what the loss of this batch is without any."""
        if number >= FEW:
            self._first_network = None
            return
        if self._first_network is None:
            self._first_network = self._learner.make_untrained()
        self._untrained.add(self._learner.compute_loss(self._first_network, batch))

    def _take_snapshot(self, step: int) -> None:
        learner = _copy(self._learner.state())
        self._snapshot = {"step": step, "losses": self._losses.state(), "learner": learner}

    def _go_back_to(self, snapshot: dict[str, Any], fault: str, judgement: Judgement) -> Setback:
        self._count(fault)
        self._learner.restore(_copy(snapshot["learner"]))
        self._losses.restore(snapshot["losses"])
        return Setback(snapshot["step"], judgement.now, judgement.usual)

    def read_loss(self) -> float:
        """The loss of the last step."""
        return self._losses.read()[-1]

    def go_back(self, fault: str) -> None:
        """Give the learner the validated state, and half the rate from now on.

        Raises DivergedError, with `fault` in its message, if nothing is kept, or after `MOST` times.
        """
        if self.step is None:
            raise DivergedError(fault)
        self._count(fault)
        self.give(fault)

    def _count(self, fault: str) -> None:
        if self.recoveries == MOST:
            raise DivergedError(f"{fault}, after the run has gone back {MOST} times")
        self.recoveries += 1
        self._learner.rate_factor *= FACTOR

    def give(self, fault: str) -> None:
        """Give the learner the validated state; DivergedError, with `fault` in its message, if nothing is kept."""
        if self.step is None:
            raise DivergedError(fault)
        self._learner.restore(_copy(self._kept))  # a copy, as the optimiser changes the tensors it is given
        self._losses, self._snapshot = RecentLosses(), None  # those after it

    def state(self) -> dict[str, Any]:
        """Its part of a checkpoint, beside `recent`; the rest is in a file beside it, by `save_with`."""
        return {"good": self.step, "recoveries": self.recoveries, "rate_factor": self._learner.rate_factor}

    def recent(self, step: int) -> dict[str, Any]:
        """The losses and the snapshot, for a checkpoint at a step, which is itself the snapshot if that is as old."""
        snapshot = self._snapshot
        if snapshot is not None and snapshot["step"] == step:
            snapshot = {**snapshot, "learner": None}
        return {"losses": self._losses.state(), "untrained": self._untrained.state(), "snapshot": snapshot}

    def restore(self, state: dict[str, Any], run: Path) -> None:
        """Continue, and let the learner continue, from a checkpoint's state and the file beside it.

        No validated state is kept if the file is gone, and none at all without `recover`. Raises StoreError if it
        cannot be read, and SpecError if the weights do not fit the network.
        """
        with name_misfit(run, self._settings.network.architecture):
            self._learner.restore(state)
        own = state["recovery"]
        self.recoveries, self._learner.rate_factor = own["recoveries"], own["rate_factor"]
        if not self._settings.recover:
            return
        if own["good"] is not None and (kept := _load(run / GOOD)).get("step") == own["good"]:
            self._kept, self.step = kept, own["good"]
        if recent := state.get("recent"):  # a validated state, taken for a checkpoint, has none
            self._losses.restore(recent["losses"])
            self._untrained.restore(recent["untrained"])
            if snapshot := recent["snapshot"]:
                self._snapshot = {**snapshot, "learner": _copy(snapshot["learner"] or self._learner.state())}

    @contextmanager
    def save_with(self, run: Path) -> Iterator[None]:
        """Write the kept state; inside, the checkpoint that refers to it is written; then it replaces the one before.

        So a run that is killed at any moment finds the state that its last checkpoint refers to, by `settle_files`.
        """
        if self._is_new:
            checkpoint.save(run / NEXT, self._kept)
        yield
        if self._is_new:
            with store_errors("keep the last good state", run):
                (run / NEXT).replace(run / GOOD)
            self._is_new = False


def settle_files(run: Path, step: int | None) -> None:
    """Finish the work of a killed run: make the state that its last checkpoint refers to, kept at `step`, GOOD."""
    with store_errors("keep the last good state", run):
        if step is None:
            (run / GOOD).unlink(missing_ok=True)
        if step is not None and _load(run / NEXT).get("step") == step:
            (run / NEXT).replace(run / GOOD)
        (run / NEXT).unlink(missing_ok=True)


def _load(path: Path) -> dict[str, Any]:
    """The content of a file; empty if there is none."""
    return checkpoint.load(path, without=WITHOUT) if path.exists() else {}


def _copy(value: Any, device: torch.device | None = None) -> Any:
    """The value with copies of its tensors, on a device, or each on its own."""
    if isinstance(value, Tensor):
        return value.detach().to(value.device if device is None else device, copy=True)
    if isinstance(value, Mapping):
        return {key: _copy(member, device) for key, member in value.items()}
    return [_copy(member, device) for member in value] if isinstance(value, list) else value
