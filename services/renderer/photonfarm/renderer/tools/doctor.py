"""What works on this machine, and remedies for what does not; each check is a real use, not a look at versions."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, cast

from photonfarm.core.errors import PhotonfarmError, QueueError, StoreError, store_errors
from photonfarm.core.processes import can_render, end_on_ctrl_c
from photonfarm.core.waiting import Log, tell_waiting
from photonfarm.farm.devices import Cards, cards_here
from photonfarm.renderer.worker.settings import WorkerSettings
from photonfarm.store.io.storage import open_storage

if TYPE_CHECKING:
    from photonfarm.store.io.objects import ObjectStorage


@dataclass(frozen=True, slots=True)
class MachineCheck:
    """The result of one check."""

    name: str
    works: bool
    detail: str
    exit_code: int = 0  # of the command, if this check fails and is required


def examine(store: str | Path, redis_url: str, log: Log = lambda _: None) -> Iterator[MachineCheck]:
    """Every check in turn; optional parts that are absent are reported and give exit code 0."""
    yield _packages()
    yield _optional(_cards(cards_here()), "needed by `--device cuda` only")
    renderer = _try("renderer", lambda: _renders(log))
    yield renderer if can_render() else _optional(renderer, "needed by workers and by verbs that look into a scene")
    yield _try("store", lambda: _writes(store))
    yield _optional(_try("embedded Redis", _starts_redis), "needed by `up` and `photonfarm redis` only")
    yield _optional(
        _try("Redis", lambda: _reaches(redis_url)),
        "needed by `submit` without --no-queue and `work` without --share, not by `up`",
    )
    yield _optional(_scenes(), "needed by the ready specs under scenes/ only")


def _packages() -> MachineCheck:
    names = ("photonfarm", "mitsuba", "drjit", "torch", "zarr", "rq", "redis")
    return MachineCheck("packages", True, ", ".join(f"{name} {_version(name)}" for name in names))


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


def _try(name: str, check: Callable[[], str]) -> MachineCheck:
    try:
        return MachineCheck(name, True, check())
    except PhotonfarmError as error:
        return MachineCheck(name, False, str(error), error.exit_code)


def _optional(finding: MachineCheck, note: str) -> MachineCheck:
    return finding if finding.works else MachineCheck(finding.name, False, f"{finding.detail} ({note})")


def _cards(here: Cards) -> MachineCheck:
    """The NVIDIA cards, their driver and OptiX; without them the processor renders."""
    driver = f"driver {here.driver or 'of unknown version'}, CUDA {here.cuda // 100}.{here.cuda % 100}"
    cards = [
        f"cuda:{card.number} {card.name}, compute capability {card.capability}, {card.memory_bytes / 2**30:.0f} GiB"
        for card in here.cards
    ]
    if here.trouble:
        return MachineCheck("GPU", False, "; ".join([here.trouble, *([driver] if cards else []), *cards]))
    return MachineCheck("GPU", True, "; ".join([*cards, driver, "OptiX"]))


@end_on_ctrl_c()
def _renders(log: Log) -> str:
    from photonfarm.renderer.scene import backend
    from photonfarm.renderer.scene.loaded_scene import LoadedScene
    from photonfarm.scene.spec_loading import load_spec
    from photonfarm.scene.view import sample_view

    mi = backend.load(threads=1)
    spec = load_spec("cornell")
    start = time.perf_counter()
    with tell_waiting(log, "rendering a Cornell box"):
        image = LoadedScene.load(spec).render_half(sample_view(spec, b"", 0, 0), seed=0)
    seconds = time.perf_counter() - start
    size = f"{spec.film.width} × {spec.film.height}"
    where = backend.device().name
    return (
        f"{mi.variant()} on {where}: bdpt rendered a Cornell box, {size}, mean {image.mean():.3f}, in {seconds:.1f} s"
    )


def _writes(store: str | Path) -> str:
    if isinstance(store, str):
        return _writes_to_bucket(store)
    try:
        folder = next(p for p in (store.absolute(), *store.absolute().parents) if p.exists())
        with tempfile.TemporaryDirectory(dir=folder, prefix=".doctor-"):
            free_gb = shutil.disk_usage(folder).free / 1e9
    except OSError as error:
        raise StoreError(f"{store}: cannot be written: {error.strerror}") from error
    reserve_gb = WorkerSettings.model_fields["reserve_bytes"].default / 1e9
    if free_gb < reserve_gb:
        raise StoreError(
            f"{store}: can be written, but {free_gb:.1f} GB are free, and `photonfarm work` takes no job below "
            f"{reserve_gb:g} GB; make room, or give it a smaller --reserve"
        )
    return f"{store} can be written, {free_gb:.0f} GB free"


def _writes_to_bucket(url: str) -> str:
    with store_errors("write", url):
        cast("ObjectStorage", open_storage(url)).check()
    return f"{url} can be written, and does not overwrite where it must not"


def _starts_redis() -> str:
    from photonfarm.farm.redis_server import EmbeddedRedis

    with tempfile.TemporaryDirectory() as folder, EmbeddedRedis(Path(folder)) as server:
        return _reaches(server.url)


def _reaches(url: str) -> str:
    from redis import RedisError

    from photonfarm.queue.connection import connect

    try:
        return f"version {connect(url).info('server')['redis_version']}"
    except QueueError:
        raise
    except (RedisError, OSError) as error:
        raise QueueError(f"Redis failed while it was asked for its version: {error}") from error


def _scenes() -> MachineCheck:
    from photonfarm.scene.spec_loading import SCENES_VARIABLE

    folders = [Path(p) for p in os.environ.get(SCENES_VARIABLE, "").split(os.pathsep) if p]
    names = sorted(scene.parent.name for folder in folders for scene in folder.glob("*/scene.xml"))
    detail = ", ".join(names) or f"no scene files; set {SCENES_VARIABLE} to the folder that holds them"
    return MachineCheck("scenes", bool(names), detail)
