"""The training loop: steps at the pace of the store, validation, checkpoints, exact resume."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch

from photonfarm.shared.errors import IncompleteError, SpecError
from photonfarm.shared.store import store_errors
from photonfarm.trainer import checkpoint
from photonfarm.trainer.dataset import Batch, SampleSource
from photonfarm.trainer.evaluation import batches, measure, network_predictor
from photonfarm.trainer.feed import Feed
from photonfarm.trainer.following import Following, Growth
from photonfarm.trainer.losses import LOSSES
from photonfarm.trainer.metrics_log import MetricsLog
from photonfarm.trainer.model import SceneFrame, build, usable_device
from photonfarm.trainer.run_folder import held
from photonfarm.trainer.settings import TrainSettings

T = TypeVar("T")

CHECKPOINT = "checkpoint.pt"
INITIAL = "initial.pt"
METRICS = "metrics.jsonl"
SETTINGS = "settings.json"
LOG_EVERY = 50  # steps
NAP_SECONDS = 0.05  # between looks at the feed while there is nothing to train on


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a session of training ended."""

    step: int
    reason: str  # "steps", "seconds" or "stopped"
    last_error: float | None  # held-out, noise removed; None if it ended before the first validation


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """An event that SIGTERM and SIGINT set, for `train`; for the main thread of a process."""
    stop = threading.Event()
    names = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(name, lambda *_: stop.set()) for name in names]
    try:
        yield stop
    finally:
        for name, handler in zip(names, before, strict=True):
            signal.signal(name, handler)


def train(
    source: SampleSource,
    settings: TrainSettings,
    run: Path,
    *,
    stop: threading.Event | None = None,
    clock: Callable[[], float] = time.monotonic,
    script: Growth | None = None,
    listen: Callable[[dict[str, Any]], None] | None = None,
    count: Callable[[int, int], None] | None = None,
    waited: float = 0.0,
) -> Outcome:
    """Train on a source while it grows, or continue a run; everything is left in the directory `run`.

    Waits for the source to have a scene. Ends at `max_steps`, at `max_seconds`, or when `stop` is set; each leaves a
    checkpoint. `script` repeats the growth of an earlier run, to the bit on a CPU. `listen` gets each record of
    metrics.jsonl as it is written; `count`, after each step and where a run begins, how many draws there were by then
    and how many samples have arrived. `waited` seconds have gone by already. Raises SpecError for a run of another
    network or scene, a device that is not there or a hold-out that leaves nothing, StoreError for a folder that cannot
    be written or that another trainer has, IncompleteError for a loss that is not finite; the last checkpoint stays.
    """
    torch.set_num_threads(settings.threads)
    usable_device(settings.device)
    stop = stop or threading.Event()
    began = clock() - waited
    with held(run):
        while not source.ready():
            if stop.wait(settings.poll_seconds) or clock() - began >= (settings.max_seconds or math.inf):
                return Outcome(0, "stopped" if stop.is_set() else "seconds", None)
        with Feed(source, settings, clock) as feed:
            log = MetricsLog(run / METRICS, listen)
            return Session(feed, settings, run, log, stop, clock, script, count).run(waited=clock() - began)


class Session:
    """One session of a run, from its start or its last checkpoint to its end."""

    def __init__(
        self,
        feed: Feed,
        settings: TrainSettings,
        run: Path,
        log: MetricsLog,
        stop: threading.Event,
        clock: Callable[[], float],
        script: Growth | None,
        count: Callable[[int, int], None] | None,
    ) -> None:
        self._count = count
        self._feed, self._settings, self._run, self._log = feed, settings, run, log
        self._stop, self._clock = stop, clock
        self._device = usable_device(settings.device)
        frame = SceneFrame.of(feed.spec, feed.geometry, feed.cloud, settings.network)
        self._network = build(settings.network, frame, settings.seed).to(self._device)
        self._optimiser = torch.optim.Adam(
            self._network.parameters(),
            lr=settings.learning_rate,
            betas=(settings.beta1, settings.beta2),
            fused=True,  # one pass over the weights; half the time of the default on a CPU
        )
        self._following = Following(feed, settings, script)
        self._step = 0
        self._seconds = {"train": 0.0, "validate": 0.0, "wait_data": 0.0, "wait_read": 0.0}
        self._last_error: float | None = None

    def run(self, waited: float = 0.0) -> Outcome:
        """Train until something ends it; `waited` seconds have gone by waiting for the scene."""
        self._begin()
        self._seconds["wait_data"] += waited
        while (reason := self._ended()) is None:
            if self._step % self._settings.validate_every == 0 and self._wait(self._can_validate):
                self._validate()
            if (batch := self._wait(self._next_batch)) is not None:
                self._train_step(batch)
            if self._step % self._settings.checkpoint_every == 0:
                self._save()
        if reason != "stopped" and self._following.held_out:
            self._validate()
        self._save()
        self._log.write("end", step=self._step, reason=reason, **self._counts())
        return Outcome(self._step, reason, self._last_error)

    def _begin(self) -> None:
        path = self._run / CHECKPOINT
        if path.exists():
            self._continue(path)
        else:
            checkpoint.save(self._run / INITIAL, {"network": self._network.state_dict(), **self._identity()})
        with store_errors("write the settings", self._run):
            (self._run / SETTINGS).write_text(self._settings.model_dump_json(indent=2) + "\n")
        self._log.cut(self._step)
        self._tell_count()

    def _continue(self, path: Path) -> None:
        state = checkpoint.load(path)
        checkpoint.check_continues(path, state, **self._identity())
        self._network.load_state_dict(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        torch.set_rng_state(state["rng"])
        self._step, self._seconds, self._last_error = state["step"], state["seconds"], state["last_error"]
        self._following.restore(state["following"])

    def _identity(self) -> dict[str, Any]:
        return {
            "scene_id": self._feed.spec.scene_id,
            "network_settings": self._settings.network.model_dump(),
            "batch": self._settings.batch,
            "hold_out": self._settings.hold_out,
            "seed": self._settings.seed,
        }

    def _save(self) -> None:
        state = {
            "network": self._network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "rng": torch.get_rng_state(),
            "step": self._step,
            "seconds": self._seconds,
            "last_error": self._last_error,
            "following": self._following.state(),
        }
        checkpoint.save(self._run / CHECKPOINT, {**state, **self._identity()})

    def _ended(self) -> str | None:
        if self._stop.is_set():
            return "stopped"
        if self._step >= self._settings.max_steps:
            return "steps"
        if self._settings.max_seconds is not None and sum(self._seconds.values()) >= self._settings.max_seconds:
            return "seconds"
        return None

    # -----------------------------------------------------------------------------------------------------------------

    @contextmanager
    def _timed(self, what: str) -> Iterator[None]:
        began = self._clock()
        try:
            yield
        finally:
            self._seconds[what] += self._clock() - began

    def _wait(self, look: Callable[[], T | None]) -> T | None:
        """Wait for data until `look` finds something, and return it; None once training has ended."""
        while not (found := look()):
            if self._ended() is not None:
                return None
            with self._timed("wait_data"):
                self._stop.wait(NAP_SECONDS)
        return found

    def _next_batch(self) -> Batch | None:
        if not self._following.draw_ahead(self._settings.max_steps):
            return None
        with self._timed("wait_read"):
            return self._following.take()

    def _can_validate(self) -> bool:
        self._following.look()
        if self._following.complete:
            self._check_split()
        return bool(self._following.held_out) and (self._step > 0 or self._following.may_draw())

    def _check_split(self) -> None:
        rule = f"hold_out = {self._settings.hold_out:g}: of the {len(self._following.growth.rows)} samples planned"
        if not self._following.held_out:
            raise SpecError(
                f"{rule} none is held out, and one is needed to validate on; raise it, or plan more configurations"
            )
        if not self._following.training_rows:
            raise SpecError(f"{rule} all are held out, and none is left to train on; lower it, or plan more")

    def _validate(self) -> None:
        """Log the held-out error of the network as it is."""
        rows = self._following.held_out[: self._settings.validation_samples]
        with self._timed("validate"):
            self._following.drop()
            found = batches(self._feed, rows, self._settings.batch)
            try:
                held_out = measure(network_predictor(self._network), found)
            except IncompleteError:  # a repair has taken all of them back, for now
                return
            finally:
                self._following.ask_again()
        self._last_error = held_out.error.mean
        self._log.write(
            "validation",
            step=self._step,
            error=held_out.error.mean,
            standard_error=held_out.error.standard_error,
            noise_floor=held_out.floor,
            held_out=len(held_out.per_sample),
            **self._counts(),
        )

    def _used(self) -> tuple[int, int]:
        """Draws so far, and samples that have arrived."""
        return self._step * self._settings.batch, len(self._following.growth.rows)

    def _tell_count(self) -> None:
        if self._count is not None:
            self._count(*self._used())

    def _counts(self) -> dict[str, Any]:
        draws, samples = self._used()
        return {"draws": draws, "samples": samples, "seconds": {k: round(v, 3) for k, v in self._seconds.items()}}

    def _train_step(self, batch: Batch) -> None:
        """One step of Adam [supplement 3.1]."""
        with self._timed("train"):
            rate = self._rate()
            for group in self._optimiser.param_groups:
                group["lr"] = rate
            batch = batch.to(self._device)
            loss = LOSSES[self._settings.loss](self._network(batch.inputs), batch.target)
            value = loss.item()
            if not math.isfinite(value):
                raise IncompleteError(
                    f"step {self._step}: the loss is {value} on rows {list(batch.rows)}; training cannot go on. "
                    f"The last checkpoint in {self._run} is kept; a smaller learning_rate or a larger batch may help"
                )
            self._optimiser.zero_grad()
            torch.autograd.backward(loss)
            self._optimiser.step()
        self._step += 1
        self._tell_count()
        if self._step % LOG_EVERY == 0:
            self._log.write("train", step=self._step, loss=value, rate=rate, **self._counts())

    def _rate(self) -> float:
        epoch = self._step * self._settings.batch // self._settings.epoch_samples
        return self._settings.learning_rate * self._settings.decay**epoch


def read_settings(run: Path) -> TrainSettings:
    """The settings a run was made with. Raises SpecError if there is no run."""
    try:
        return TrainSettings.model_validate(json.loads((run / SETTINGS).read_text()))
    except (OSError, ValueError) as error:
        raise SpecError(f"{run}: is not a training run: {error}") from error
