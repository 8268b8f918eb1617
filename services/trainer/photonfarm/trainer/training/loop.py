"""The training loop: steps at the pace of the store, validation, checkpoints, exact resume."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch

from photonfarm.core.errors import store_errors
from photonfarm.core.formatting import format_count
from photonfarm.core.models import Changes
from photonfarm.core.processes import Stop
from photonfarm.core.statistics import group_means
from photonfarm.store import SceneReader
from photonfarm.trainer.data.batch import ResidentSamples, TrainingBatch
from photonfarm.trainer.data.batch_stream import BatchStream
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.predictors.evaluation import make_network_predictor, read_batches
from photonfarm.trainer.predictors.half_filter import choose_filter, settle_filter
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.advice import LEARNED_BY_HEART, advise
from photonfarm.trainer.runs.devices import Ranks, usable_device
from photonfarm.trainer.runs.progress import Stopwatch, TimeKind, divide_by_used, share_waits
from photonfarm.trainer.runs.run_folder import CHECKPOINT, INITIAL, METRICS, SETTINGS, MetricsLog, lock_run, read_log
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.runs.user_code import name_in_errors
from photonfarm.trainer.training.good_state import GoodState, Setback, settle_files
from photonfarm.trainer.training.learner import DivergedError, Learner, name_compile_errors
from photonfarm.trainer.training.other_ranks import Presence
from photonfarm.trainer.training.start_from import start_from
from photonfarm.trainer.training.validation import BestValidations, Comparison, Show, Standing, Validation, validate

T = TypeVar("T")

LOG_EVERY = 50  # steps, a multiple of `LOOK_EVERY`, by which losses are read
NAP_SECONDS = 0.05  # between looks at the feed while there is nothing to train on


@dataclass(frozen=True, slots=True)
class TrainingOutcome:
    """How a session of training ended."""

    step: int
    reason: str  # "steps", "seconds", "rounds", "stopped" or `LEARNED_BY_HEART`
    last_error: float | None  # held-out, noise removed; None if it ended before the first validation


@dataclass(frozen=True, slots=True)
class Hooks:
    """What a session of training calls and heeds; each part may be left out."""

    stop: Stop = field(default_factory=Stop)  # ends the session once it is set
    on_record: Callable[[dict[str, Any]], object] | None = None  # gets each record of metrics.jsonl as it is written
    on_draws: Callable[[int, int], object] | None = None  # gets draws so far, and samples that have arrived
    on_phase: Callable[[TimeKind], object] | None = None  # what the time is spent on from now on
    on_images: Show | None = None  # at each validation, with the first held-out samples
    on_wait: Callable[[str], object] = lambda _: None  # gets a sentence on what is waited for, or goes on
    ranks: Ranks = field(default_factory=Ranks)  # the processes that share each batch; this one is rank 0
    waited: float = 0.0  # seconds that have passed already
    clock: Callable[[], float] = time.monotonic


def train(source: SceneReader, settings: TrainSettings, run: Path, hooks: Hooks | None = None) -> TrainingOutcome:
    """Train on a source while it grows, or resume a run; everything is left in the directory `run`.

    Waits for the source to have a scene, and at any time for whoever takes the scene's lease. Ends at `max_steps`, at
    `max_seconds`, after its rounds, with noise learned by heart, or when `hooks.stop` is set; each leaves a checkpoint.

    Raises SpecError for a run of another network, scene or store, a device that is not there or a hold-out that leaves
    nothing; StoreError for a folder that cannot be written or that another trainer has; DivergedError if the losses or
    the held-out error are not finite, or much worse than before, and there is no good state, or the run has gone back
    too often; the last checkpoint stays.
    """
    hooks, settings = hooks or Hooks(), settle_filter(settings, run)
    torch.set_num_threads(settings.threads)
    usable_device(settings.device)
    watch = Stopwatch(hooks.clock, "wait_data", hooks.waited, hooks.on_phase)

    def is_over() -> bool:
        return sum(watch.seconds.values()) >= (settings.max_seconds or math.inf)

    with lock_run(run), Presence(source, f"trainer of run {run}", hooks.on_wait) as presence:
        while not source.ready() and not is_over() and not hooks.stop.wait(settings.poll_seconds):
            pass
        if not source.ready() or not presence.begin(hooks.stop, is_over):
            return TrainingOutcome(0, "stopped" if hooks.stop.is_set() else "seconds", None)
        watch.turn("start")
        own = {"architecture": settings.network.architecture, "loss": settings.loss}
        resident = ResidentSamples(hooks.ranks.device(settings.device), settings.resident_gb)
        fed = Feed(source, settings, hooks.clock, resident=resident, finish=choose_filter(settings, run))
        with fed as feed, name_in_errors(**own), name_compile_errors(settings.compile):
            return Session(feed, settings, run, watch, hooks, presence).run()


class Session:
    """One session of a run, from its start or its last checkpoint to its end."""

    def __init__(
        self, feed: Feed, settings: TrainSettings, run: Path, watch: Stopwatch, hooks: Hooks, presence: Presence
    ) -> None:
        self._presence, self._missing = presence, 0
        self._feed, self._settings, self._run, self._watch, self._hooks = feed, settings, run, watch, hooks
        self._stop = hooks.stop
        self._log = MetricsLog(run / METRICS, hooks.on_record)
        frame = SceneFrame.of(feed.spec, *feed.base, settings.network)
        self._learner = Learner(frame, settings, hooks.ranks)
        self._good = GoodState(self._learner, settings)
        self._best = BestValidations()
        self._stream = BatchStream(feed, settings, hooks.ranks)
        self._step = 0
        self._last_error: float | None = None
        self._end_before: dict[str, Any] = {}  # the record of the last session's end, if it had these settings
        self._validated: int | None = None  # the step of the log's last validation
        self._standing: Standing | None = None  # of this session's last one, unless the run has gone back since
        self._seconds_logged: dict[str, float] = {}  # at the last validation

    def run(self) -> TrainingOutcome:
        """Train until something ends it; a run that has ended, and has nothing to go on with, stays as it is."""
        self._begin()
        self._watch.turn("other")
        if (reason := self._end_before.get("reason")) is not None and self._ends_again(reason):
            goes_on = "further passes or images" if reason == LEARNED_BY_HEART else "--steps N"
            self._hooks.on_wait(f"{self._run}: has ended at step {self._step} ({reason}); with {goes_on} it goes on")
            return TrainingOutcome(self._step, reason, self._last_error)
        if self._step and self._ended() is None:
            self._hooks.on_wait(f"{self._run}: continues at step {self._step}")
        while (reason := self._ended()) is None:
            due = self._step % self._settings.validate_every == 0 and self._step != self._validated
            if due and self._wait(self._can_validate):
                self._validate()
                self._keep_or_go_back()
                continue
            if (batch := self._wait(self._next_batch)) is not None:
                self._train_step(batch)
            if self._step % self._settings.checkpoint_every == 0:
                self._save()
        if reason != "stopped" and self._stream.held_out and self._presence.is_there and not self._missing:
            self._end_no_worse()
        self._save()
        advice = advise(read_log(self._run / METRICS))
        self._log.write("end", step=self._step, reason=reason, advice=advice and advice.sentence, **self._counts())
        return TrainingOutcome(self._step, reason, self._last_error)

    def _begin(self) -> None:
        path = self._run / CHECKPOINT
        changed = self._continue(path) if (continues := path.exists()) else self._start()
        with store_errors("write the settings", self._run):
            (self._run / SETTINGS).write_text(self._settings.model_dump_json(indent=2) + "\n")
        kept = self._log.cut(self._step) if continues else []
        self._end_before = kept[-1] if kept and kept[-1]["kind"] == "end" and not changed else {}
        self._validated = next((r["step"] for r in reversed(kept) if r["kind"] == "validation"), None)
        if changed:
            self._log.write("changes", step=self._step, changes=changed)
        if self._learner.verdict is not None:
            self._log.write("loss", step=self._step, loss=self._settings.loss, verdict=str(self._learner.verdict))
        self._report_draws()

    def _start(self) -> Changes:
        self._send_begin(continues=False)
        settle_files(self._run, None)
        self._log.cut(-1)
        if self._settings.start_from is not None:
            begun = start_from(self._learner, self._feed.spec.scene_id, self._settings, self._hooks.on_wait)
            self._log.write("start", step=0, **begun)
        checkpoint.save(self._run / INITIAL, {"network": self._learner.state()["network"], **self._identity()})
        return {}

    def _continue(self, path: Path) -> Changes:
        """Resume from a checkpoint; returns the changed settings."""
        state = checkpoint.load(path)
        changed = checkpoint.check_continues(path, state, self._identity())
        checkpoint.check_same_store(path, state, self._feed.plan_requests())
        recovery = state["recovery"]
        settle_files(self._run, recovery["good"])
        self._good.restore(state, self._run)
        if self._good.step is not None:  # without a state to go back to, a best is of no use
            self._best.restore(recovery)
        self._step, self._last_error = state["step"], state["last_error"]
        self._watch.add(state["seconds"])
        self._seconds_logged = dict(state["seconds"])
        self._send_begin(continues=True)
        self._feed.expect(state["following"]["arrived"].tolist())
        self._stream.restore(state["following"])
        self._stream.look()
        return changed

    def _send_begin(self, *, continues: bool) -> None:
        spec = self._feed.spec
        beginning = {"scene_id": spec.scene_id, "exposure": spec.exposure, "step": self._step, "continues": continues}
        self._hooks.ranks.send("begin", beginning)

    def _identity(self) -> dict[str, Any]:
        spec = self._feed.spec
        return {
            "scene_id": spec.scene_id,
            "exposure": spec.exposure,
            "settings": self._settings.model_dump(mode="json"),
        }

    def _save(self) -> None:
        with self._watch.on("save"):
            recovery = {**self._good.state(), **self._best.state()}
            recent = self._good.recent(self._step)
            state = {**self._learner.state(), **self._state(), "recovery": recovery, "recent": recent}
            with self._good.save_with(self._run):
                checkpoint.save(self._run / CHECKPOINT, state)

    def _keep(self) -> None:
        """Keep this state as the good one; without one to go back to before it, it is a checkpoint of its own."""
        recovery = {**self._good.state(), "good": None, "best": None, "least": None}
        self._good.keep(self._step, {**self._state(), "recovery": recovery})

    def _state(self) -> dict[str, Any]:
        """What a checkpoint says beyond the learner and what it may go back to."""
        plans, samples = list(self._feed.plan_requests()), len(self._stream.arrived)
        return {
            **self._identity(),
            "step": self._step,
            "seconds": self._watch.seconds,
            "last_error": self._last_error,
            "following": self._stream.state(),
            "store": {"scene_id": self._feed.spec.scene_id, "plans": plans, "samples": samples},
            "versions": checkpoint.list_versions(),
        }

    def _ended(self) -> str | None:
        if self._stop.is_set():
            return "stopped"
        if self._step >= self._settings.max_steps:
            return "steps"
        if self._stream.last_step is not None and self._step >= self._stream.last_step:
            return "rounds"
        if self._standing is not None and self._standing.learns_by_heart and self._stream.complete:
            return LEARNED_BY_HEART
        if self._settings.max_seconds is not None and sum(self._watch.seconds.values()) >= self._settings.max_seconds:
            return "seconds"
        return None

    def _ends_again(self, reason: str) -> bool:
        """Whether what ended the last session ends this one too."""
        if reason == LEARNED_BY_HEART:
            return self._stream.complete and len(self._stream.arrived) == self._end_before["samples"]
        return reason in ("steps", "rounds") and reason == self._ended()

    # -----------------------------------------------------------------------------------------------------------------

    def _wait(self, look: Callable[[], T | None]) -> T | None:
        """Wait until the samples are there and `look` finds something, and return it; None once training has ended."""
        while not (self._are_samples_there() and (value := look())):
            if self._ended() is not None:
                return None
            with self._watch.on("wait_data"):
                self._stop.wait(NAP_SECONDS)
        return value

    def _are_samples_there(self) -> bool:
        """Whether all samples that have arrived are complete; first leave the scene to whoever has taken its lease.

        Those that a repair has set aside are rendered again, and training waits until then, so it never sees fewer.
        """
        if self._presence.is_to_end():
            with self._watch.on("wait_data"), self._feed.quiet():
                self._hooks.ranks.send("quiet")
                self._hooks.ranks.meet()  # no process reads any more
                self._presence.end()
                self._presence.begin(self._stop, lambda: self._ended() is not None)
                self._hooks.ranks.send("on")
        before, self._missing = self._missing, self._feed.missing
        if self._missing and not before:
            self._hooks.on_wait(
                f"training waits: {format_count(self._missing, 'sample')} set aside, for workers to render again"
            )
        return self._presence.is_there and not self._missing

    def _next_batch(self) -> TrainingBatch | None:
        if not self._stream.draw_ahead(self._settings.max_steps):
            return None
        with self._watch.on("wait_read"):
            return self._stream.take()

    def _can_validate(self) -> bool:
        self._stream.look()
        if self._stream.complete:
            self._stream.check_split()
        return bool(self._stream.held_out) and (self._step > 0 or self._stream.may_draw())

    def _validate(self) -> None:
        """Log the held-out error of the predicting network, and compare it with the best before."""
        self._standing = None
        rows = self._feed.first_of_views(self._stream.held_out)[: self._settings.validation_samples]
        with self._watch.on("validate"):
            self._stream.drop()
            held_out_batches = read_batches(self._feed, rows, self._settings.batch)
            predict, loss = make_network_predictor(self._learner.predicting.eval()), self._settings.loss
            measure = self._learner.measure_excess
            now = validate(
                predict, self._step, held_out_batches, self._hooks.on_images, loss=loss, measure_excess=measure
            )
            self._learner.network.train()
            self._stream.ask_again()
        self._validated = self._step
        if self._settings.recover:
            excess = self._learner.excess
            self._standing = self._best.place(now, None if excess is None else float(excess))
        elif not now.is_finite:
            raise DivergedError(f"the held-out error of step {self._step} is {now.held_out.error.mean}")
        if now.is_finite:
            self._log_validation(now)

    def _log_validation(self, now: Validation) -> None:
        held_out = now.held_out
        self._last_error = held_out.error.mean
        self._log.write(
            "validation",
            step=self._step,
            error=held_out.error.mean,
            standard_error=held_out.error.standard_error,
            shown_error=float(group_means(held_out.shown, held_out.units).mean()),
            noise_floor=held_out.floor,
            held_out=len(held_out.per_sample),
            waits=share_waits(seconds := self._watch.seconds, self._seconds_logged),
            excess_held_out=now.excess and [now.excess.mean, now.excess.standard_error],
            poor=self._learner.take_poor(),
            **self._learner.describe_excess(self._step / max(len(self._stream.training_rows), 1)),
            **self._counts(),
        )
        self._seconds_logged = seconds

    def _keep_or_go_back(self) -> None:
        """Keep the state after the last validation, or go back, in all processes; neither if the run ends there."""
        if self._standing is None or self._ended() == LEARNED_BY_HEART:
            return
        if (error := self._standing.error).is_clearly_worse:
            reason = f"step {self._step}: {error.sentence}"
            self._hooks.ranks.send("back", reason)
            self._good.go_back(reason)
            self._log_recovered("held-out error", error)
        elif self._standing.is_good:
            self._hooks.ranks.send("keep", self._step)
            self._keep()

    def _end_no_worse(self) -> None:
        """Validate the last step, and end with the last good state if the last one is worse than allowed."""
        if self._step != self._validated:
            self._validate()
        if (standing := self._standing) is None:
            return
        if (rise := standing.rise) is not None:
            self._good.give(f"step {self._step}: {rise.sentence}")
            self._log_recovered(LEARNED_BY_HEART if standing.learns_by_heart else "end", rise)
            self._validate()
        elif standing.is_good:
            self._keep()

    def _log_recovered(self, cause: str, found: Comparison | Setback) -> None:
        self._standing = None  # the learner has changed
        self._log.write(
            "recovered",
            step=self._step,
            cause=cause,
            back_to=found.back_to if isinstance(found, Setback) else self._good.step,
            errors=_describe(now=found.error, best=found.best) if isinstance(found, Comparison) else None,
            what=found.what if isinstance(found, Comparison) else "loss",
            losses=_describe(now=found.now, usual=found.usual) if isinstance(found, Setback) else None,
            recoveries=self._good.recoveries,
            rate_factor=self._learner.rate_factor,
        )

    def _report_draws(self) -> None:
        if self._hooks.on_draws is not None:
            self._hooks.on_draws(self._step * self._settings.batch, len(self._stream.arrived))

    def _counts(self) -> dict[str, Any]:
        draws, samples = self._step * self._settings.batch, len(self._stream.arrived)
        ahead = round(divide_by_used(samples, draws), 3)
        seconds = {k: round(v, 3) for k, v in self._watch.seconds.items()}
        return {"draws": draws, "samples": samples, "samples_per_used": ahead, "seconds": seconds}

    def _train_step(self, batch: TrainingBatch) -> None:
        with self._watch.on("train"):
            self._learner.last_step = self._stream.last_step
            setback = self._good.take_step(self._step, batch)
        self._step += 1
        self._report_draws()
        if setback is not None:
            self._log_recovered("loss", setback)
        elif self._step % LOG_EVERY == 0:
            rate, loss = self._learner.rate(self._step - 1), self._good.read_loss()
            self._log.write("train", step=self._step, loss=loss, rate=rate, **self._counts())


def _describe(**values: float) -> dict[str, float | None]:
    """The values, with None for those that are not finite, for which JSON has no number."""
    return {name: value if math.isfinite(value) else None for name, value in values.items()}
