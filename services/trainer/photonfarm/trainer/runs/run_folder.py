"""The folder of a training run: its settings, its lock, its log metrics.jsonl, and its pictures of held-out views.

The log has one record a line, appended during training. The pictures let others watch a few views improve.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from photonfarm.core.errors import SpecError, StoreError, store_errors
from photonfarm.core.files import whole_file
from photonfarm.core.models import sentences
from photonfarm.core.pictures import display
from photonfarm.core.records import F32
from photonfarm.farm.training import CHECKPOINT, INITIAL, METRICS, NO_FOLDER, SETTINGS, VIEWS
from photonfarm.scene.spec_loading import SCENES_VARIABLE
from photonfarm.trainer.runs.settings import EARLIER, KEYS, NetworkSettings, TrainSettings

__all__ = [
    "CHECKPOINT",
    "INITIAL",
    "METRICS",
    "SETTINGS",
    "lock_run",
    "make_environment",
    "note_scene_folder",
    "read_settings",
]

LOCK = "lock"
GOOD = "good.safetensors"  # a checkpoint of the last good validation, which a run that diverges goes back to
SCENE_FOLDER = "scene-folder.txt"


@contextmanager
def lock_run(folder: Path) -> Iterator[None]:
    """Make the folder and lock it; raises StoreError if another trainer has it or it cannot be written.

    The system releases the lock when its process ends, however it ends.
    """
    with store_errors("keep a training run here", folder):
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("ab")
    with file:
        with store_errors("lock the training run", folder):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise StoreError(f"{folder}: another trainer is at work on this run; use another run folder") from error
        yield


def note_scene_folder(folder: Path, scenes: Path | None) -> None:
    """Note where the run's scene file lies on this machine, for `make_environment`; None leaves what was noted."""
    if scenes is not None:
        with store_errors("note where the scene lies", folder):
            (folder / SCENE_FOLDER).write_text(f"{scenes}\n")


def make_environment(folder: Path) -> dict[str, str]:
    """The environment in which the renderer's verbs find a run's scene: where a variable says, else where noted."""
    try:
        noted = (folder / SCENE_FOLDER).read_text().strip()
    except (OSError, UnicodeDecodeError):
        return dict(os.environ)
    folders = filter(None, (os.environ.get(SCENES_VARIABLE), noted))
    return {**os.environ, SCENES_VARIABLE: os.pathsep.join(folders)}


def find_own_settings(run: Path, changes: Mapping[str, Any]) -> TrainSettings | None:
    """The settings that a run was begun with; None for a new one, also where another network is to begin anew.

    Raises what `read_settings` does.
    """
    if not (run / SETTINGS).exists() or ("architecture" in changes and not (run / CHECKPOINT).exists()):
        return None
    return read_settings(run)


def read_settings(run: Path) -> TrainSettings:
    """The settings a run was made with.

    Raises StoreError if there is no run or its settings cannot be read, SpecError for those of another version.
    """
    path = run / SETTINGS
    try:
        document = json.loads(path.read_text())
        settings = TrainSettings.model_validate(document)
    except FileNotFoundError as error:
        if not run.is_dir():
            raise StoreError(f"{run}: there is no such run; `photonfarm train` makes one") from error
        raise StoreError(
            f"{run}: is not a training run (it holds no {SETTINGS}), or one that still waits for samples"
        ) from error
    except NotADirectoryError as error:
        raise StoreError(f"{run}: {NO_FOLDER}") from error
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise StoreError(f"{path}: {'; '.join(sentences(error, KEYS))}") from error
    except ValueError as error:
        raise StoreError(f"{path}: is not the JSON that a training run leaves there: {error}") from error
    check_version(path, document.get("network", {}))
    return settings


def check_version(path: Path, network: Mapping[str, Any]) -> None:
    """Raise SpecError unless a run's stored settings of its network have all present keys, but for those of `EARLIER`.

    A missing key would take today's default, and make another network.
    """
    if missing := ", ".join(key for key in NetworkSettings.model_fields if key not in {**EARLIER, **network}):
        raise SpecError(
            f"{path}: lacks the network settings {missing}: another version wrote it; train anew in another folder "
            "(--run)"
        )


class MetricsLog:
    """The log of one run. `on_record` is called with each record as it is written; StoreError if the disk refuses."""

    def __init__(self, path: Path, on_record: Callable[[dict[str, Any]], object] | None = None) -> None:
        self._path, self._on_record = path, on_record

    def cut(self, step: int) -> list[dict[str, Any]]:
        """Drop the records after the checkpoint of `step`, which a resumed run writes again.

        Returns the records that stay. They are renamed into place, so that a concurrent reader always finds a whole
        file. A record of training up to `step`, or of a return by the losses there, was written before the checkpoint,
        and so was everything up to an end there; a validation or a change of settings without an end after it was
        written after the checkpoint.
        """
        with store_errors("cut the log", self._path):
            lines = _read_lines(self._path)
            records = [_parse_record(line, self._path) for line in lines if line.endswith(b"\n")]
            ends = [i + 1 for i, record in enumerate(records) if (record["step"], record["kind"]) == (step, "end")]
            kept = max(ends, default=0)
            while kept < len(records) and not _is_after(records[kept], step):
                kept += 1
            if kept < len(lines):
                partial = self._path.with_suffix(".partial")
                partial.write_bytes(b"".join(lines[:kept]))
                partial.replace(self._path)
            return records[:kept]

    def write(self, kind: str, **values: Any) -> None:
        """Append a record."""
        record = {"kind": kind, **values}
        with store_errors("write the log", self._path), self._path.open("ab") as file:
            file.write(json.dumps(record).encode() + b"\n")
        if self._on_record:
            self._on_record(record)


def _is_after(record: dict[str, Any], step: int) -> bool:
    of_a_step = record["kind"] == "train" or record.get("cause") == "loss"
    return record["step"] > step or (record["step"] == step and not of_a_step)


def _read_lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True) if path.exists() else []


def _parse_record(line: bytes, path: Path) -> dict[str, Any]:
    try:
        record: dict[str, Any] = json.loads(line)
        _ = record["step"], record["kind"]
        return record
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError(
            f"{path}: holds the line {line[:40]!r}, which is not a record of a training run; remove that line"
        ) from error


def read_log(path: Path) -> list[dict[str, Any]]:
    """The whole records of a log, in order; a last line cut short by a crash is left out. Raises StoreError."""
    with store_errors("read the log", path):
        return [_parse_record(line, path) for line in _read_lines(path) if line.endswith(b"\n")]


def read_shares(run: Path) -> dict[str, float]:
    """What the runs that a run's weights began with held out of each scene at the least; {} if they began at random."""
    first = [_parse_record(line, run / METRICS) for line in _read_lines(run / METRICS)[:1]]
    return first[0].get("hold_out", {}) if first and first[0]["kind"] == "start" else {}


SHOWN = 4  # the most views
MOST = 24  # the most pictures kept; beyond, every second one goes, so that early ones become rare
_NAME = re.compile(r"step-(\d{8})\.png")


def write_views(run: Path, scene_id: str, step: int, rows: tuple[int, ...], predictions: F32) -> None:
    """Write the first predictions, exposed linear radiance (B, H, W, 3), side by side as a display shows them.

    The PNG's texts `scene` and `rows` name what they belong to in the store. Raises StoreError if the disk refuses.
    """
    from PIL import Image, PngImagePlugin

    rows, folder = rows[:SHOWN], run / VIEWS
    about = PngImagePlugin.PngInfo()
    about.add_text("scene", scene_id)
    about.add_text("rows", " ".join(map(str, rows)))
    strip = np.concatenate([display(image, 1.0) for image in predictions[: len(rows)]], axis=1)
    with store_errors("write pictures of held-out views", folder):
        with whole_file(folder / f"step-{step:08d}.png") as part:
            Image.fromarray(strip).save(part, "PNG", pnginfo=about)
        _thin_out(folder)


def _thin_out(folder: Path) -> None:
    files = sorted(file for file in folder.iterdir() if _NAME.fullmatch(file.name))
    if len(files) > MOST:
        for file in files[1:-1:2]:
            file.unlink(missing_ok=True)
