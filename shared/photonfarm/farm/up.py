"""The whole farm on one machine: an embedded Redis, render workers and the trainer, as processes of one terminal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from itertools import cycle
from pathlib import Path
from types import MappingProxyType

from photonfarm.core.errors import IncompleteError, SpecError, store_errors
from photonfarm.core.formatting import format_count
from photonfarm.core.processes import command, free_port, tie
from photonfarm.core.waiting import Log
from photonfarm.farm.devices import CPU
from photonfarm.farm.hold_out_checks import check_hold_out, choose_hold_out
from photonfarm.farm.progress import FarmProgress
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.running_farm import WEB_PORT, announce
from photonfarm.farm.submission import submit, top_up
from photonfarm.farm.training import RunFolder, check_run, hold_out_of
from photonfarm.farm.watch import FarmWatch
from photonfarm.plan.hold_out import HOLD_OUT
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp, spp_per_pass
from photonfarm.scene.plausibility import warnings
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import SCENES_VARIABLE, NamedSpec, find_spec
from photonfarm.store import Store
from photonfarm.store.model.store import scene_status

WORKERS = 2
"""The workers on a processor, unless another number is asked for."""

POLL_S = 0.5
LOOK_S = 2.0  # between looks at the store and Redis
STOP_S = 7.0  # for all processes to end: a worker gives its job 5 s, and Docker gives this one 10 s
AT_ONCE_S = 1.0  # for processes to end after a second request, even in the middle of a job
PAGES = "web"

Process = subprocess.Popen[bytes]
Display = AbstractContextManager[Callable[[FarmProgress, bool], None]]
"""A context manager that gives a function: it is called with each look at the farm, and with True for the last."""


def trainer_arguments(
    spec: str, *, run: Path, train_steps: int, hold_out: float, train_options: Sequence[str] = ()
) -> list[str]:
    """The trainer's verb with its arguments; `train_options` are further ones, as `photonfarm train` takes them."""
    own = ["--run", str(run), "--steps", str(train_steps), "--hold-out", str(hold_out)]
    return ["train", spec, *own, *train_options]


def run_farm(
    spec: str,
    store: str | Path,
    request: Request,
    say: Log,
    display: Display,
    *,
    workers: int,
    run: Path,
    train_steps: int,
    hold_out: float | None,
    out: Path,
    train_options: Sequence[str] = (),
    also: Mapping[str, int] = MappingProxyType({}),
    reference_views: int = 0,
    reference_spp: int = 256,
    shard_rows: int | None = None,
    web: bool = True,
    devices: Sequence[str] = (CPU,),
    reserve: str | None = None,
) -> None:
    """Submit, render, train, and write the report and the preview; raises IncompleteError if a part fails.

    Networks of `also` are trained meanwhile, each for its steps and with the same options, in RUN-NAME. The first
    `reference_views` held-out views get `reference_spp` samples per pixel, which are merged in `out`, and the report
    compares networks with them. `reserve` is that of the workers. Without a `hold_out` it is the run's, or
    of a new run the default or just enough for one configuration. With `web`, pages that show all of it are served on
    this machine until the end. Workers render on the `devices` in turn.

    A wrong spec, a run of another scene, a hold-out that leaves one side empty, and references of no valid number are
    refused before anything is written, by a SpecError.
    After any interruption the same call resumes, as the store and the trainer's checkpoints remain.
    """
    named = NamedSpec.load(spec)
    for warning in warnings(named):
        say(f"warning: {warning}")
    references = reference_views > 0
    trained = {"trainer": (run, train_steps, [*train_options])} if train_steps else {}
    for name, steps in also.items():
        trained[f"trainer-{name}"] = (run_beside(run, name), steps, [*train_options, "--architecture", name])
    runs = [each for each, *_ in trained.values()]
    for each in runs:
        check_run(each, named.spec, store)
    asked = hold_out or hold_out_of(run)
    splits = train_steps or references
    share = _checked_hold_out(named.spec, store, asked, request, say) if splits else asked or HOLD_OUT
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
        planned = submit(
            named,
            store,
            redis.url,
            request,
            retry=True,
            shard_rows=shard_rows,
            workers=workers,
            on_card=CPU not in devices,
        )
        say(f"{format_count(planned.planned, 'sample')} planned, {planned.planned_before} planned before")
        if references:
            added = top_up(named, store, redis.url, str(reference_spp), where=which, retry=True)
            there = f"passes that the samples have, or that were planned before: {added.planned_before}"
            say(f"references: {added.planned} further passes planned; {there}")
        opened = Store(store)
        rows = opened.scene(planned.scene_id).plans()[0].shard_rows
        say(f"samples come in jobs of {rows}; a worker's first also loads the scene and compiles its kernels")
        environment = _environment(spec, store, redis.url)
        verbs = {}
        for name, device in zip((f"worker-{i + 1}" for i in range(workers)), cycle(devices), strict=False):
            scene = ["--scene", planned.scene_id, "--name", name, "--device", device]
            verbs[name] = ["work", "--until-complete", *scene, *([] if reserve is None else ["--reserve", reserve])]
        for name, (each, steps, own) in trained.items():
            verbs[name] = trainer_arguments(spec, run=each, train_steps=steps, hold_out=share, train_options=own)
        address, shown = None, [word for each in runs for word in ("--run", str(each))]
        if web:
            port = free_port(WEB_PORT)
            address = f"http://localhost:{port}/"
            verbs[PAGES] = ["web", *(shown or ["--run", str(run)]), "--port", str(port)]
            say(f"watch it at {address}")
        stack.enter_context(announce(opened, redis_url=redis.url, run=run if train_steps else None, web=address))
        running = stack.enter_context(_processes(verbs, environment, run, say))
        preview = ["preview", planned.scene_id, "--out", str(out / "preview.html")]
        try:
            watch = FarmWatch(opened, redis.url, runs, scene_id=planned.scene_id)
            with display as show:
                _watch(running, watch, redis, show, run)
            beside: list[str] = []
            if references:
                passes = -(-reference_spp // spp_per_pass(named.spec))
                folder = str(out / "references")
                merge = ["--scene", planned.scene_id, "--least", str(passes), "--out", folder]
                _call(["store", "merge", *merge], environment)
                beside = ["--references", folder]
            if train_steps:
                _tell_of_late_samples(run, scene_status(opened.scene(planned.scene_id)).samples_complete, say)
                _call(["report", *shown, "--out", str(out), *beside], environment)
        except IncompleteError as error:
            try:
                _call(preview, environment)  # the samples rendered so far can still be looked at
            except IncompleteError as second:
                raise IncompleteError(f"{error}. After that, {second}") from error
            raise
        _call(preview, environment)


def run_beside(run: Path, name: str) -> Path:
    """The folder of a further network's run: RUN-NAME, beside RUN."""
    named = run if run.name.strip(".") else run.resolve()  # a folder such as . has no name of its own
    return named.with_name(f"{named.name}-{name}")


def _checked_hold_out(spec: SceneSpec, store: str | Path, asked: float | None, request: Request, say: Log) -> float:
    """The share to hold out, as asked for or just enough; raises SpecError if it would leave one side empty."""
    if asked is not None:
        check_hold_out(spec, store, asked, request)
        return asked
    share = choose_hold_out(spec, store, request)
    if share != HOLD_OUT:
        say(f"hold-out {share:g}, as {HOLD_OUT:g} would not suit so few configurations")
    return share


def _tell_of_late_samples(run: Path, samples: int, say: Log) -> None:
    """Say how many of a scene's complete samples had landed when a run ended, if these were not all."""
    (folder := RunFolder(run)).look()
    end = next((record for record in reversed(folder.records) if record["kind"] == "end"), None)
    if end is not None and end["samples"] < samples:
        say(
            f"training ended at step {end['step']}, when {end['samples']} of {samples} samples had landed; the same "
            "command with more --train-steps trains on with all of them"
        )


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
    verbs: Mapping[str, list[str]], environment: Mapping[str, str], logs: Path, say: Log
) -> Iterator[dict[str, Process]]:
    """Run each verb as a process of its own; at the end all are asked to stop at once, and waited for together."""
    running: dict[str, Process] = {}
    try:
        for name, verb in verbs.items():
            with (logs / f"{name}.log").open("ab") as log:
                running[name] = subprocess.Popen(
                    tie(command(*verb)),
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # Ctrl-C in the terminal is for us; they are asked to stop once, by us
                )
        yield running
    finally:
        alive = {name: process for name, process in running.items() if process.poll() is None}
        if alive.keys() - {PAGES}:
            say("stopping; a job in hand that is not nearly done will be rendered again")
        _stop([*alive.values()])


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


def _watch(
    running: Mapping[str, Process],
    watch: FarmWatch,
    redis: EmbeddedRedis,
    show: Callable[[FarmProgress, bool], None],
    logs: Path,
) -> None:
    """Show progress until every process but the pages has ended; raises IncompleteError as soon as one has failed."""
    looked = -LOOK_S
    while True:
        redis.keep_running()
        codes = {name: process.poll() for name, process in running.items() if name != PAGES}
        last = None not in codes.values() or any(codes.values())
        if last or time.monotonic() - looked >= LOOK_S:
            looked = time.monotonic()
            show(watch.look(), last)
        for name, code in codes.items():
            if code:
                log = logs / f"{name}.log"
                end = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
                (*_, last_line) = log.read_text(errors="replace").strip().splitlines() or ["nothing"]
                said = f"{name} {end}; {log} says: {last_line}. What is rendered and trained"
                if code == SpecError.exit_code:  # the same command would be refused again
                    raise IncompleteError(f"{said} is kept")
                raise IncompleteError(f"{said} is kept, and the same command goes on from there")
        if last:
            return
        time.sleep(POLL_S)
