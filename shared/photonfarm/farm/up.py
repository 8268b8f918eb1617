"""The whole farm on one machine: an embedded Redis, render workers and the trainer, as processes of one terminal."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

from photonfarm.core.errors import IncompleteError, SpecError, store_errors
from photonfarm.core.processes import command, free_port, tie
from photonfarm.farm.devices import CPU
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.running_farm import WEB_PORT, announce
from photonfarm.farm.status import NoQueue, StoreQueue, queue_now, waits
from photonfarm.farm.submission import check_hold_out, choose_hold_out, submit, top_up
from photonfarm.farm.training import RunFolder, TrainingProgress, check_run, hold_out_of
from photonfarm.plan.hold_out import HOLD_OUT
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp, spp_per_pass
from photonfarm.queue import QueueStatus
from photonfarm.scene.plausibility import warnings
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import SCENES_VARIABLE, NamedSpec, find_spec
from photonfarm.store import SceneStore, Store

WORKERS = 2
"""The workers on a processor, unless another number is asked for."""

POLL_S = 0.5
ASK_S = 2.0  # between questions to Redis
STOP_S = 7.0  # for all processes to end: a worker gives its job 5 s, and Docker gives this one 10 s
AT_ONCE_S = 1.0  # for processes to end after a second request, even in the middle of a job

Process = subprocess.Popen[bytes]
CommittedAndPlanned = tuple[int, int]
"""How many rows are committed, and how many are planned."""


@dataclass(frozen=True, slots=True)
class FarmProgress:
    """How far rendering and training are."""

    samples: CommittedAndPlanned
    passes: CommittedAndPlanned  # further ones, of views that have samples
    step: int
    steps: int
    note: str  # what training does and its last held-out error, in words
    in_hand: int = 0  # samples and passes that are rendered, in jobs that are not committed yet
    doing: tuple[str, ...] = ()  # what each worker does, in words
    waits: tuple[str, ...] = ()  # what waits for what, in sentences


class Talk(Protocol):
    """Where a farm says what it does."""

    def say(self, line: str) -> None:
        """Say a sentence."""

    def progress(self, steps: int) -> AbstractContextManager[Callable[[FarmProgress, bool], None]]:
        """A context manager that gives a function: call it with each progress, and with True for the last."""


def trainer_arguments(spec: str, *, run: Path, train_steps: int, hold_out: float) -> list[str]:
    """The trainer's verb with its arguments."""
    return ["train", spec, "--run", str(run), "--steps", str(train_steps), "--hold-out", str(hold_out)]


def worker_arguments(scene_id: str, name: str, device: str) -> list[str]:
    """A worker's verb with its arguments."""
    return ["work", "--until-complete", "--scene", scene_id, "--name", name, "--device", device]


def run_farm(
    spec: str,
    store: str | Path,
    request: Request,
    talk: Talk,
    *,
    workers: int,
    run: Path,
    train_steps: int,
    hold_out: float | None,
    out: Path,
    reference_views: int = 0,
    reference_spp: int = 256,
    shard_rows: int | None = None,
    web: bool = True,
    devices: Sequence[str] = (CPU,),
) -> None:
    """Submit, render, train, and write the report and the preview; raises IncompleteError if a part fails.

    The first `reference_views` held-out views get `reference_spp` samples per pixel, and the report compares networks
    with them. Without a `hold_out` it is the run's, or of a new run the default or just enough for one configuration.
    With `web`, pages that show all of it are served on this machine until the end. Workers render on the `devices` in
    turn.

    A wrong spec, a run of another scene, a hold-out that leaves one side empty, and references of no valid number are
    refused before anything is written, by a SpecError.
    After any interruption the same call resumes, as the store and the trainer's checkpoints remain.
    """
    named = NamedSpec.load(spec)
    for warning in warnings(named):
        talk.say(f"warning: {warning}")
    references = train_steps > 0 and reference_views > 0
    if train_steps:
        check_run(run, named.spec, store)
    asked = hold_out or hold_out_of(run)
    share = _checked_hold_out(named.spec, store, asked, request, talk) if train_steps else asked or HOLD_OUT
    which = (f"held-out={share}", f"views=first:{reference_views}")  # of the planned views get references
    if references:
        TopUp.of(str(reference_spp), which)
    with store_errors("keep the logs of a run here", run):
        run.mkdir(parents=True, exist_ok=True)
    with store_errors("keep preview and report here", out):  # found out now, and not when all is trained
        out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        stack.enter_context(_unwound_by_sigterm())
        redis = stack.enter_context(EmbeddedRedis(run / "redis"))
        planned = submit(named, store, redis.url, request, retry=True, shard_rows=shard_rows, workers=workers)
        talk.say(f"{planned.planned} samples planned, {planned.planned_before} planned before")
        if references:
            added = top_up(named, store, redis.url, str(reference_spp), where=which, retry=True)
            there = f"passes that the samples have, or that were planned before: {added.planned_before}"
            talk.say(f"references: {added.planned} further passes planned; {there}")
        opened = Store(store)
        scene = opened.scene(planned.scene_id)
        rows = scene.plans()[0].shard_rows
        talk.say(f"samples come in jobs of {rows}; a worker's first also loads the scene and compiles its kernels")
        environment = _environment(spec, store, redis.url)
        verbs = {
            f"worker-{i + 1}": worker_arguments(planned.scene_id, f"worker-{i + 1}", devices[i % len(devices)])
            for i in range(workers)
        }
        if train_steps:
            verbs["trainer"] = trainer_arguments(spec, run=run, train_steps=train_steps, hold_out=share)
        address = stack.enter_context(_pages(store, redis.url, run, talk)) if web else None
        trained = run if train_steps else None
        stack.enter_context(announce(opened, redis_url=redis.url, run=trained, web=address))
        running = stack.enter_context(_processes(verbs, environment, run, talk))
        preview = ["preview", planned.scene_id, "--out", str(out / "preview.html")]
        try:
            farm = _Farm(scene, run, train_steps, partial(queue_now, opened, redis.url))
            _watch(running, farm, redis, talk)
            if train_steps:
                beside: list[str] = []
                if references:
                    passes = -(-reference_spp // spp_per_pass(scene.spec))
                    folder = str(out / "references")
                    merge = ["--scene", planned.scene_id, "--least", str(passes), "--out", folder]
                    _call(["store", "merge", *merge], environment)
                    beside = ["--references", folder]
                _call(["report", "--run", str(run), "--out", str(out), *beside], environment)
        except IncompleteError as error:
            try:
                _call(preview, environment)  # the samples rendered so far can still be looked at
            except IncompleteError as second:
                raise IncompleteError(f"{error}. After that, {second}") from error
            raise
        _call(preview, environment)


def _checked_hold_out(spec: SceneSpec, store: str | Path, asked: float | None, request: Request, talk: Talk) -> float:
    """The share to hold out, as asked for or just enough; raises SpecError if it would leave one side empty."""
    if asked is not None:
        check_hold_out(spec, store, asked, request)
        return asked
    share = choose_hold_out(spec, store, request)
    if share != HOLD_OUT:
        talk.say(f"hold-out {share:g}, as {HOLD_OUT:g} would not suit so few configurations")
    return share


@contextmanager
def _unwound_by_sigterm() -> Iterator[None]:
    """Let SIGTERM raise as Ctrl-C does, so that the child processes are stopped."""
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _environment(spec: str, store: str | Path, redis_url: str) -> dict[str, str]:
    """The environment of the child processes; it adds the spec's folder, where its scene file may lie."""
    scenes = (os.environ.get(SCENES_VARIABLE), str(find_spec(spec).absolute().parent))
    variables = {"PHOTONFARM_STORE": str(store), "PHOTONFARM_REDIS_URL": redis_url}
    return {**os.environ, **variables, SCENES_VARIABLE: os.pathsep.join(filter(None, scenes))}


def _call(arguments: list[str], environment: Mapping[str, str]) -> None:
    code = subprocess.run(command(*arguments), env=environment, check=False).returncode
    if code:
        raise IncompleteError(f"photonfarm {arguments[0]} ended with exit code {code}; what it said stands above")


@contextmanager
def _processes(
    verbs: Mapping[str, list[str]], environment: Mapping[str, str], logs: Path, talk: Talk
) -> Iterator[dict[str, Process]]:
    """Run each verb as a process of its own; at the end all are asked to stop at once, and waited for together."""
    running: dict[str, Process] = {}
    try:
        for name, verb in verbs.items():
            running[name] = _start(verb, environment, logs / f"{name}.log")
        yield running
    finally:
        alive = [process for process in running.values() if process.poll() is None]
        if alive:
            talk.say("stopping; a job in hand that is not nearly done will be rendered again")
            _stop(alive)


def _start(arguments: list[str], environment: Mapping[str, str], log: Path) -> Process:
    with log.open("ab") as output:
        return subprocess.Popen(
            tie(command(*arguments)),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C in the terminal is for us; they are asked to stop once, by us
        )


def _stop(processes: list[Process]) -> None:
    """Stop all processes: gracefully at first, forcibly after STOP_S or at a second Ctrl-C or SIGTERM."""
    try:
        _ask(processes, STOP_S)
    finally:
        _ask(processes, AT_ONCE_S)
        for process in processes:
            process.kill()
            process.wait()


def _ask(processes: list[Process], seconds: float) -> None:
    """Send SIGTERM to all that are alive, and wait until they have ended or the time is over."""
    for process in processes:
        process.terminate()
    end = time.monotonic() + seconds
    with suppress(subprocess.TimeoutExpired):
        for process in processes:
            process.wait(max(end - time.monotonic(), 0.0))


@contextmanager
def _pages(store: str | Path, redis_url: str, run: Path, talk: Talk) -> Iterator[str]:
    """Serve the farm's pages until the block ends; yields their address."""
    port = free_port(WEB_PORT)
    verb = ["web", "--store", str(store), "--redis", redis_url, "--run", str(run), "--port", str(port)]
    process = _start(verb, os.environ, run / "web.log")
    address = f"http://localhost:{port}/"
    talk.say(f"watch it at {address}")
    try:
        yield address
    finally:
        _stop([process])


class _Farm:
    """The progress of rendering and training, read from their files and their queue."""

    def __init__(
        self, scene: SceneStore, run: Path, steps: int, ask: Callable[[], StoreQueue | NoQueue] | None = None
    ) -> None:
        """Take the scene, the trainer's folder, and how to ask for the queue, which is done now and then."""
        self.scene = scene
        self.run = run
        self.steps = steps
        self._training = RunFolder(run)
        self._ask = ask
        self._queue: StoreQueue | NoQueue = NoQueue("not asked yet")
        self._asked_s = -math.inf

    def look(self) -> FarmProgress:
        """Count the samples and the further passes of their views, and read the trainer's log."""
        trained = self._training.look() if self.steps else TrainingProgress("")  # else its files are of another run
        found, status = self.scene.progress(), self._status()
        passes = found.committed_passes, found.planned_passes
        samples = found.committed_samples - passes[0], found.planned_samples - passes[1]
        named = {self.scene.scene_id: self.scene.spec.name}
        missing = found.planned_samples - found.committed_samples
        activities = status.activities if status and missing else {}  # a report may be seconds old
        return FarmProgress(
            samples,
            passes,
            trained.step,
            self.steps,
            trained.note,
            min(sum(each.done for each in activities.values()), found.planned_samples - found.committed_samples),
            tuple(f"{name} {each}" for name, each in sorted(activities.items())),
            tuple(map(str, waits(self._queue, named, 0))),
        )

    def _status(self) -> QueueStatus | None:
        """The queue's status, at most `ASK_S` old; None while nothing is known of it."""
        if self._ask is not None and time.monotonic() - self._asked_s >= ASK_S:
            self._queue, self._asked_s = self._ask(), time.monotonic()
        return self._queue.status if isinstance(self._queue, StoreQueue) else None


def _watch(running: Mapping[str, Process], farm: _Farm, redis: EmbeddedRedis, talk: Talk) -> None:
    """Show progress until every process has ended; raises IncompleteError as soon as one has failed."""
    with talk.progress(farm.steps) as show:
        while True:
            redis.keep_running()
            codes = {name: process.poll() for name, process in running.items()}
            alive = None in codes.values()
            show(farm.look(), not alive or any(codes.values()))
            for name, code in codes.items():
                if code:
                    log = farm.run / f"{name}.log"
                    said = f"{name} {_end(code)}; {log} says: {_tail(log)}. What is rendered and trained"
                    if code == SpecError.exit_code:  # the same command would be refused again
                        raise IncompleteError(f"{said} is kept")
                    raise IncompleteError(f"{said} is kept, and the same command goes on from there")
            if not alive:
                return
            time.sleep(POLL_S)


def _end(code: int) -> str:
    return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


def _tail(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "nothing"
