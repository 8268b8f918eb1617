"""The trainer as a service: it waits for a store and a scene, trains as samples arrive, and shows that it is alive."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import ValidationError
from redis import Redis, RedisError

from photonfarm.core.errors import IncompleteError, QueueError, SpecError, StoreError
from photonfarm.core.processes import Stop, repeat, stop_on_signals
from photonfarm.scene.spec import Film
from photonfarm.scene.spec_loading import load_spec, scene_folder
from photonfarm.store import SceneReader, Store
from photonfarm.store.io.storage import is_vacant
from photonfarm.store.model.scene_store import list_scenes
from photonfarm.store.read.find import describe_scenes
from photonfarm.trainer.runs import user_code
from photonfarm.trainer.runs.progress import RunProgress, follow_progress
from photonfarm.trainer.runs.run_folder import (
    CHECKPOINT,
    INITIAL,
    find_own_settings,
    lock_run,
    note_scene_folder,
    write_views,
)
from photonfarm.trainer.runs.settings import TrainSettings, make_settings

if TYPE_CHECKING:
    from photonfarm.core.records import F32
    from photonfarm.scene.spec import SceneSpec
    from photonfarm.trainer.dry_run import DryRun
    from photonfarm.trainer.training.loop import Hooks

T = TypeVar("T")

POLL_S = 1.0
ALIVE_FILE = "alive"
REPORT_S = 5.0  # between reports to the workers
ALIVE_S = 60.0  # a run whose sign of life is older counts as dead


def settle_settings(folder: Path, preset: str | None, changes: Mapping[str, Any]) -> TrainSettings:
    """A run's settings with changes by key: those of a named preset, or of the run, or of a new run's device.

    Raises SpecError for changes that cannot be, StoreError for a run's settings that cannot be read.
    """
    if preset is None and (own := find_own_settings(folder, changes)):
        return make_settings(own, changes)
    from photonfarm.trainer.runs.devices import AUTO, choose_preset  # loads torch

    return make_settings(preset or choose_preset(changes.get("device", AUTO)), changes)


def run(
    spec: str | None,
    store: str | Path,
    folder: Path,
    preset: str | None,
    changes: dict[str, Any],
    redis_url: str | None = None,
    *,
    scene_id: str | None = None,
    until_complete: bool = False,
    log: Callable[[str], object],
    on_record: Callable[[dict[str, Any]], object] | None = None,
) -> None:
    """Train on one scene of a store, until the settings' end, SIGTERM or SIGINT; all leave a checkpoint.

    The settings are those of `settle_settings`. The scene is that of the spec or the id; without both, that of the run,
    or the store's only one. The time spent waiting for a scene, its
    base and its samples counts. With a Redis, the used samples are reported to workers. Under torchrun, rank 0 does all
    this, and the other ranks train with it until it ends; all need the same folder. `log` takes sentences about the
    service, `on_record` each record of the run's log.

    Raises IncompleteError if the time is over before there is anything to train on, and with `until_complete` also if a
    signal stops it; StoreError where a run goes on and the store does not hold its scene.
    """
    from photonfarm.trainer.networks import find_kind
    from photonfarm.trainer.predictors.half_filter import settle_filter
    from photonfarm.trainer.runs.devices import describe_device, join_ranks
    from photonfarm.trainer.training.loop import Hooks
    from photonfarm.trainer.training.other_ranks import assist
    from photonfarm.trainer.training.start_from import check_same_network

    settings = settle_filter(settle_settings(folder, preset, changes), folder)
    for key, name in (("architecture", settings.network.architecture), ("loss", settings.loss)):
        if user_code.is_own(name):
            user_code.load(key, name)  # so that a mistake is said before samples are waited for
    if settings.start_from is not None and not (folder / CHECKPOINT).exists():
        known_otherwise = check_same_network(Path(settings.start_from), settings)  # likewise
        if known_otherwise:
            log(known_otherwise)
    with join_ranks(settings.device, settings.batch) as ranks, stop_on_signals() as stop:
        device = ranks.device(settings.device)
        if ranks.rank:
            assist(lambda scene_id, exposure: SceneReader(store, scene_id, exposure=exposure), settings, folder, ranks)
            return
        with ranks.lead():
            log(f"training on {describe_device(device, settings.network.precision)}")
            if find_kind(settings.network.architecture).needs.passes:
                also = "and by Open Image Denoise" if settings.network.has_denoiser else "alone"
                log(f"filter = {settings.network.filter}: noisy halves are filtered by a filter of our own {also}")
            loaded = load_spec(spec) if spec else None
            scene_id = loaded.scene_id if loaded else scene_id
            begun_on, exposure = _read_beginning(folder)
            if scene_id and begun_on and scene_id != begun_on:
                raise SpecError(
                    f"{folder}: was trained on scene {begun_on}, and {scene_id} is asked for; use another run folder, "
                    f"in which --start-from {folder} begins with its weights"
                )
            if begun_on and (is_vacant(store) or not Store(store).has_scene(begun_on)):
                raise StoreError(
                    f"{store}: holds no scene {begun_on}, on which run {folder} was begun; --store names the store "
                    "that does, and another --run begins anew"
                )
            with _give_sign_of_life(folder):
                note_scene_folder(folder, scene_folder(spec, loaded) if spec and loaded else None)
                hooks = Hooks(stop=stop, on_record=on_record, on_wait=log, ranks=ranks)
                _train(loaded, store, scene_id or begun_on, exposure, folder, settings, redis_url, hooks)
        if until_complete and stop.is_set():
            raise IncompleteError(f"{folder}: a signal stopped it; the same command continues it")


def _train(
    spec: SceneSpec | None,
    store: str | Path,
    scene_id: str | None,
    exposure: float | None,
    folder: Path,
    settings: TrainSettings,
    redis_url: str | None,
    hooks: Hooks,
) -> None:
    """Train as the only process or as rank 0: wait for a scene, report, and write event files for TensorBoard."""
    from photonfarm.trainer.runs.tensorboard import open_event_files
    from photonfarm.trainer.training.loop import train

    began, log, on_record = time.monotonic(), hooks.on_wait, hooks.on_record
    if is_vacant(store):
        log(f"waiting for a store and a scene in {store} (--store): `photonfarm submit` makes them")
    limit_s = settings.max_seconds or math.inf
    scene_id = scene_id or _wait_for(lambda: _find_only_scene(store), hooks.stop, limit_s)
    if scene_id is None and not hooks.stop.is_set():
        raise IncompleteError(f"{store}: no scene to train on has come in {limit_s:g} s; nothing was trained")
    if scene_id is None:
        log(f"{store}: no scene to train on has come; nothing was trained")
        return
    source, waited = SceneReader(store, scene_id, exposure=exposure), time.monotonic() - began
    if not is_vacant(store) and not source.ready():
        log(f"waiting for scene {scene_id}, {_describe_lack(Store(store), scene_id, spec)}")
    elif spec is not None and source.ready() and spec.exposure != source.spec.exposure:
        of = "the run began with" if exposure else "the store has"
        log(f"exposure is {source.spec.exposure:g}, which {of}, and not {spec.exposure:g} as the spec says")
    progress = RunProgress(settings.max_steps, settings.batch)
    with (
        open_event_files(folder) as board,
        _report_use(redis_url, store, scene_id, log) as report_draws,
        follow_progress(progress, folder, log),
    ):

        def note_record(record: dict[str, Any]) -> None:
            for follow in (on_record, board and board.record):
                if follow:
                    follow(record)

        def note_draws(draws: int, samples: int) -> None:
            progress.note_draws(draws, samples)
            report_draws(draws, samples)

        def show(step: int, rows: tuple[int, ...], targets: F32, predictions: F32) -> None:
            write_views(folder, source.spec.scene_id, step, rows, predictions)
            if board:
                board.pictures(step, targets, predictions)

        hooks = replace(hooks, on_record=note_record, on_draws=note_draws, on_phase=progress.phase, on_images=show)
        outcome = train(source, settings, folder, replace(hooks, waited=waited))
    log(f"ended at step {outcome.step}: {outcome.reason}")
    if outcome.reason == "seconds" and not source.ready():
        raise IncompleteError(
            f"{store}: nothing of scene {scene_id} has been rendered in {limit_s:g} s; nothing was trained"
        )


def _describe_lack(store: Store, scene_id: str, spec: SceneSpec | None) -> str:
    """What of a scene is waited for, in words."""
    if store.has_scene(scene_id):
        return "of which nothing is rendered yet"
    others = describe_scenes(store, spec) if spec else list_scenes(store.storage)
    return f"which {store.storage.where} does not hold yet; {others}"


def check(folder: Path) -> None:
    """Raise IncompleteError unless a trainer has recently given a sign of life in this run's folder."""
    try:
        age_s = time.time() - (folder / ALIVE_FILE).stat().st_mtime
    except OSError as error:
        raise IncompleteError(f"{folder}: no trainer is at work here") from error
    if age_s > ALIVE_S:
        raise IncompleteError(
            f"{folder}: the trainer's last sign of life is {age_s:.0f} s old; {ALIVE_S:.0f} s are allowed"
        )


def summarise(spec: str | None, store: str | Path, settings: TrainSettings) -> str:
    """The parameters and the work of a network, as a table; nothing is trained, and of a store only a spec is read.

    Raises SpecError without a spec, unless the store has one scene.
    """
    from photonfarm.trainer.dry_run import format_summary, summarise
    from photonfarm.trainer.networks import find_kind

    network, scene = settings.network, _find_spec(spec, store)
    points = min(network.points or scene.points, scene.points)
    head = (
        f"{network.architecture} for {scene.name}: {scene.film.width} × {scene.film.height} pixels, "
        f"width {network.width}" + (f", {points} points" if find_kind(network.architecture).needs.points else "")
    )
    with user_code.name_in_errors(architecture=network.architecture):
        return f"{head}\n{format_summary(summarise(scene, network))}"


def rehearse(
    spec: str | None, store: str | Path, settings: TrainSettings, film: int | None, tell: Callable[[str], object]
) -> DryRun:
    """What a training would take; nothing is written, and of a store only a spec is read.

    `film` is the side of images in pixels, if it shall be another than the spec's; `tell` is that of the estimate.
    Raises SpecError without a spec, unless the store has one scene, and in one of several processes.
    """
    from photonfarm.core.models import sentences
    from photonfarm.trainer.dry_run import rehearse
    from photonfarm.trainer.runs.devices import count_processes

    if (size := count_processes()) > 1:
        raise SpecError(
            f"torchrun has started {size} processes, and a dry run is one's work; start it without torchrun"
        )
    scene = _find_spec(spec, store)
    if film is not None:
        try:
            square = Film(width=film, height=film)
        except ValidationError as error:
            raise SpecError(f"the film of the dry run: {'; '.join(sentences(error))}") from error
        scene = scene.model_copy(update={"film": square})
    with user_code.name_in_errors(architecture=settings.network.architecture, loss=settings.loss):
        return rehearse(scene, settings, tell)


def _find_spec(spec: str | None, store: str | Path) -> SceneSpec:
    """The spec of a name, or of a store's only scene; SpecError without one."""
    if spec:
        return load_spec(spec)
    scene_id = _find_only_scene(store)
    if scene_id is None:
        raise SpecError(f"{store}: holds no scene; name the spec of the one to build a network for")
    return Store(store).scene(scene_id).spec


def _read_beginning(folder: Path) -> tuple[str | None, float | None]:
    """The scene that a run was begun on, and its exposure then; None for a new run."""
    from photonfarm.trainer.runs import checkpoint  # loads torch

    if not (folder / INITIAL).exists():
        return None, None
    state = checkpoint.load(folder / INITIAL)
    return str(state["scene_id"]), float(state["exposure"])


def _find_only_scene(store: str | Path) -> str | None:
    """The scene of a store that has one; None while there is no store or no scene; SpecError if there are several."""
    try:
        ids = Store(store).scene_ids()
    except StoreError:
        if not is_vacant(store):
            raise
        return None
    if len(ids) > 1:
        names = ", ".join(scene.spec.name for scene in Store(store).scenes())
        raise SpecError(f"{store}: holds {len(ids)} scenes ({names}); name the spec of the one to train on")
    return ids[0] if ids else None


def _wait_for(look: Callable[[], T | None], stop: Stop, seconds: float) -> T | None:
    """Wait until `look` finds something, and return it; None once asked to stop, or after so many seconds."""
    end = time.monotonic() + seconds
    while (value := look()) is None:
        if stop.wait(min(POLL_S, max(end - time.monotonic(), 0.0))) or time.monotonic() >= end:
            return None
    return value


@contextmanager
def _give_sign_of_life(folder: Path) -> Iterator[None]:
    """Touch a file regularly, from a thread of its own, for `check`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ALIVE_FILE).touch()
    except OSError as error:
        raise StoreError(f"{folder}: the folder of the training run cannot be written: {error.strerror}") from error
    try:
        with repeat(ALIVE_S / 4, (folder / ALIVE_FILE).touch):
            yield
    finally:
        if folder.is_dir():
            with suppress(StoreError), lock_run(folder):  # unless a trainer is at work there, which keeps the file
                (folder / ALIVE_FILE).unlink(missing_ok=True)


@contextmanager
def _report_use(
    redis_url: str | None, store: str | Path, scene_id: str, log: Callable[[str], object]
) -> Iterator[Callable[[int, int], None]]:
    """A callback for draws and samples of training; a thread reports the used ones to Redis regularly, and at the end.

    Each sample counts once, and held-out ones as soon as they are visible. A missing Redis or store is ignored; if the
    Redis serves another store, that is logged once.
    """
    used: int | None = None  # a resumed run knows it only once it has begun
    connection: Redis | None = None
    refused = ""

    def note(draws: int, samples: int) -> None:
        nonlocal used
        used = min(draws, samples)

    def report() -> None:
        nonlocal connection, refused
        if redis_url is None or used is None:
            return
        from photonfarm.queue.connection import connect
        from photonfarm.queue.workers import OtherStoreError, check_served, report_consumed

        try:
            connection = connection or connect(redis_url)
            check_served(connection, Store(store))
            report_consumed(connection, scene_id, used)
        except OtherStoreError as error:
            if not refused:
                log(f"used samples are not reported to workers: {error}")
            refused = str(error)
        except (QueueError, RedisError, StoreError):
            pass

    try:
        with repeat(REPORT_S, report):
            yield note
    finally:
        report()
