"""The trainer as a service: it waits for a store and a scene, trains as the samples come, and says that it lives."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click
from pydantic import ValidationError
from redis import Redis, RedisError

from photonfarm.shared.errors import IncompleteError, QueueError, SpecError, StoreError
from photonfarm.shared.estimate import stated
from photonfarm.shared.scene import load_spec, sentences
from photonfarm.shared.store import Store
from photonfarm.shared.store.storage import is_vacant
from photonfarm.trainer.settings import TrainSettings, small

T = TypeVar("T")

PRESETS: dict[str, Callable[..., TrainSettings]] = {"small": small, "paper": TrainSettings}

POLL_S = 1.0
ALIVE_FILE = "alive"
TELL_S = 5.0  # between figures for the workers
ALIVE_S = 60.0  # a run whose sign of life is older is taken for dead


def run(
    spec: str | None,
    store: str | Path,
    folder: Path,
    preset: str,
    changes: dict[str, Any],
    redis_url: str | None = None,
) -> None:
    """Train on one scene of a store, until the settings say stop or SIGTERM comes; both leave a checkpoint.

    Waiting for a scene, its base and its samples counts as time spent. With a Redis, workers are told what is used.
    """
    from photonfarm.trainer.loop import stop_on_signals, train
    from photonfarm.trainer.model import usable_device
    from photonfarm.trainer.store_source import StoreSource

    settings = _settings(preset, changes)
    usable_device(settings.device)
    scene_id = load_spec(spec).scene_id if spec else _begun_on(folder)
    began = time.monotonic()
    with stop_on_signals() as stop, _sign_of_life(folder):
        if is_vacant(store):
            click.echo(f"waiting for a store and a scene in {store}", err=True)
        scene_id = scene_id or _wait(lambda: _only_scene(store), stop, settings.max_seconds or math.inf)
        if scene_id is None:
            click.echo(f"{store}: no scene to train on has come; nothing was trained", err=True)
            return
        source, waited = StoreSource(store, scene_id), time.monotonic() - began
        with _consumption_told(redis_url, store, scene_id) as count:
            outcome = train(source, settings, folder, stop=stop, listen=_tell, count=count, waited=waited)
    click.echo(f"ended at step {outcome.step}: {outcome.reason}", err=True)


def check(folder: Path) -> None:
    """Raise IncompleteError unless a trainer has given a sign of life in this run's folder lately."""
    try:
        age_s = time.time() - (folder / ALIVE_FILE).stat().st_mtime
    except OSError as error:
        raise IncompleteError(f"{folder}: no trainer is at work here") from error
    if age_s > ALIVE_S:
        raise IncompleteError(
            f"{folder}: the trainer's last sign of life is {age_s:.0f} s old; {ALIVE_S:.0f} s are allowed"
        )


def _settings(name: str, changes: dict[str, Any]) -> TrainSettings:
    try:
        return PRESETS[name](**changes)
    except ValidationError as error:
        raise SpecError(f"the settings of the training: {'; '.join(sentences(error))}") from error


def _begun_on(folder: Path) -> str | None:
    """The scene that a run was begun on; None for a run that has not begun."""
    from photonfarm.trainer import checkpoint
    from photonfarm.trainer.loop import INITIAL

    begun = folder / INITIAL
    return str(checkpoint.load(begun)["scene_id"]) if begun.exists() else None


def _only_scene(store: str | Path) -> str | None:
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


def _wait(look: Callable[[], T | None], stop: threading.Event, seconds: float) -> T | None:
    """What `look` finds at last; None once told to stop, or after so many seconds."""
    end = time.monotonic() + seconds
    while (found := look()) is None:
        if stop.wait(min(POLL_S, max(end - time.monotonic(), 0.0))) or time.monotonic() >= end:
            return None
    return found


@contextmanager
def _sign_of_life(folder: Path) -> Iterator[None]:
    """Touch a file now and then, from a thread of its own, for `check`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ALIVE_FILE).touch()
    except OSError as error:
        raise StoreError(f"{folder}: the folder of the training run cannot be written: {error.strerror}") from error
    ended = threading.Event()

    def touch() -> None:
        while not ended.wait(ALIVE_S / 4):
            (folder / ALIVE_FILE).touch()

    thread = threading.Thread(target=touch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        (folder / ALIVE_FILE).unlink(missing_ok=True)


@contextmanager
def _consumption_told(redis_url: str | None, store: str | Path, scene_id: str) -> Iterator[Callable[[int, int], None]]:
    """What takes draws and samples of training; Redis is told now and then, and at the end, how many have been used.

    By a thread. Each sample counts once, and held-out ones as soon as they are seen. A Redis that is not there is none
    of our trouble, nor a store that is not there yet; that it serves another store is said once.
    """
    told = _Told(redis_url, store, scene_id)
    ended = threading.Event()

    def keep_telling() -> None:
        while not ended.wait(TELL_S):
            told.tell()

    thread = threading.Thread(target=keep_telling, daemon=True)
    thread.start()
    try:
        yield told.take
    finally:
        ended.set()
        thread.join()
        told.tell()


class _Told:
    """What Redis is told of a scene's samples."""

    def __init__(self, redis_url: str | None, store: str | Path, scene_id: str) -> None:
        self._url, self._root, self._scene_id = redis_url, store, scene_id
        self._store: Store | None = None  # opened with the first figures: before training begins there may be none
        self._used: int | None = None  # a run that continues knows only once it has begun
        self._connection: Redis | None = None
        self._refused = False

    def take(self, draws: int, samples: int) -> None:
        """Take what there was by now."""
        self._used = min(draws, samples)

    def tell(self) -> None:
        """Tell what was taken last, if there is anything and a Redis."""
        if self._url is None or self._used is None:
            return
        from photonfarm.shared import queue

        try:
            self._connection = self._connection or queue.connect(self._url)
            self._store = self._store or Store(self._root)
            queue.check_served(self._connection, self._store)
            queue.tell_consumed(self._connection, self._scene_id, self._used)
        except queue.OtherStoreError as error:
            if not self._refused:
                click.echo(f"no worker is told what is used: {error}", err=True)
            self._refused = True
        except (QueueError, RedisError, StoreError):
            pass


def _tell(record: dict[str, Any]) -> None:
    if record["kind"] == "validation":
        click.echo(
            f"step {record['step']}: held-out error {stated(record['error'], record['standard_error'])} "
            f"on {record['held_out']} of {record['samples']} samples",
            err=True,
        )
