"""Recovery of a run that gets much worse: the learner's state at its last good validation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torch import Tensor

from photonfarm.core.errors import store_errors
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import GOOD
from photonfarm.trainer.training.learner import DivergedError, Learner

NEXT = "good.next.safetensors"  # in the run's folder too, until the checkpoint that refers to it is written
WITHOUT = "remove it, and the run goes on, with nothing to go back to before its next good validation"

MOST = 8
"""How often a run may go back: by then the rate is 1/256, and it diverges for another reason."""

FACTOR = 0.5
"""The factor on the rate each time."""


class GoodState:
    """A good state of a learner, to go back to; equal in all processes of a group."""

    def __init__(self, learner: Learner) -> None:
        self._learner = learner
        self._kept: dict[str, Any] = {}  # in memory of its own
        self._is_new = False  # not in any file yet
        self.step: int | None = None  # at which it was kept; None if nothing is
        self.recoveries = 0

    def keep(self, step: int, rest: Mapping[str, Any] | None = None) -> None:
        """Keep the learner's state at a step, and the rest of a checkpoint, which makes its file one."""
        self._kept, self.step, self._is_new = _copied({**self._learner.state(), **(rest or {})}), step, True

    def step_or_go_back(self, number: int, batch: TrainingBatch) -> float | None:
        """Take a step; returns the loss, or None if it was not finite and the learner went back.

        Raises DivergedError as `go_back` does.
        """
        value = self._learner.step(number, batch)
        if math.isfinite(value):
            return value
        self.go_back(f"step {number}: the loss is {value} on rows {list(batch.rows)}")
        return None

    def go_back(self, found: str) -> None:
        """Give the learner the kept state, and half the rate from now on.

        Raises DivergedError, with `found` in its message, if nothing is kept, or after `MOST` times.
        """
        if self.recoveries == MOST:
            raise DivergedError(f"{found}, after the run has gone back {MOST} times")
        self.give(found)
        self.recoveries += 1
        self._learner.rate_factor *= FACTOR

    def give(self, found: str) -> None:
        """Give the learner the kept state; DivergedError, with `found` in its message, if nothing is kept."""
        if self.step is None:
            raise DivergedError(found)
        self._learner.restore(_copied(self._kept))  # a copy, as the optimiser changes the tensors it is given

    def state(self) -> dict[str, Any]:
        """Its part of a checkpoint; the rest is in a file beside it, by `saved_with`."""
        return {"good": self.step, "recoveries": self.recoveries, "rate_factor": self._learner.rate_factor}

    def restore(self, state: dict[str, Any], run: Path, *, recover: bool) -> None:
        """Continue, and let the learner continue, from a checkpoint's state and the file beside it.

        Nothing is kept if the file is gone, or without `recover`. Raises StoreError if it cannot be read.
        """
        self._learner.restore(state)
        if (own := state.get("recovery")) is None:  # of an older version
            return
        self.recoveries, self._learner.rate_factor = own["recoveries"], own["rate_factor"]
        if recover and own["good"] is not None and (kept := _loaded(run / GOOD)).get("step") == own["good"]:
            self._kept, self.step = kept, own["good"]

    @contextmanager
    def saved_with(self, run: Path) -> Iterator[None]:
        """Write the kept state; inside, the checkpoint that refers to it is written; then it replaces the one before.

        So a run that is killed at any moment finds the state that its last checkpoint refers to, by `settle`.
        """
        if self._is_new:
            checkpoint.save(run / NEXT, self._kept)
        yield
        if self._is_new:
            with store_errors("keep the last good state", run):
                (run / NEXT).replace(run / GOOD)
            self._is_new = False


def settle(run: Path, step: int | None) -> None:
    """Finish the work of a killed run: make the state that its last checkpoint refers to, kept at `step`, GOOD."""
    with store_errors("keep the last good state", run):
        if step is None:
            (run / GOOD).unlink(missing_ok=True)
        if step is not None and _loaded(run / NEXT).get("step") == step:
            (run / NEXT).replace(run / GOOD)
        (run / NEXT).unlink(missing_ok=True)


def _loaded(path: Path) -> dict[str, Any]:
    """The content of a file; empty if there is none."""
    return checkpoint.load(path, without=WITHOUT) if path.exists() else {}


def _copied(value: Any) -> Any:
    """The value with copies of its tensors, on the CPU."""
    if isinstance(value, Tensor):
        return value.detach().to("cpu", copy=True)
    if isinstance(value, Mapping):
        return {key: _copied(member) for key, member in value.items()}
    return [_copied(member) for member in value] if isinstance(value, list) else value
