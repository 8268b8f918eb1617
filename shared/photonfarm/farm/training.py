"""How far a training run is and what it was begun on, read from its folder, without torch."""

from __future__ import annotations

import json
import math
import os
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from photonfarm.core.errors import SpecError, StoreError
from photonfarm.core.formatting import format_count
from photonfarm.core.statistics import format_estimate
from photonfarm.core.waiting import format_span
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import Store

METRICS = "metrics.jsonl"
PROGRESS = "progress.json"
SETTINGS = "settings.json"
VIEWS = "views"
INITIAL = "initial.safetensors"
CHECKPOINT = "checkpoint.safetensors"
ALONE = ".photonfarm"
"""How the name of a network on its own ends."""

ONNX = ".onnx"
"""How that of one for programs without torch ends."""

METADATA = "photonfarm"
"""The key of a checkpoint's JSON document in the header of its file."""

MOST_HEADER_BYTES = 1 << 26

NO_FOLDER = (
    "is a file, and a training run is a folder; from a network on its own, as `photonfarm pack` writes it, one can "
    "only predict: `infer`, `live` and `open_run` take it"
)
"""What is wrong with a file that is given as a run."""

WAITS = "waits for samples"
"""The phase of a trainer that has nothing to train on."""

TRAINS = "trains"
"""The phase of a trainer while nothing holds it up."""

FRESH_S = 20.0
"""The age up to which a trainer's own word of what it does is believed; it writes one every two seconds."""


@dataclass(frozen=True, slots=True)
class TrainingProgress:
    """How far a run is."""

    run: str  # the name of its folder
    step: int = 0
    steps: int = 0  # 0: not known yet
    phase: str | None = None  # what the trainer does now; None if none is at work
    left_s: float | None = None  # until the last step, at the pace so far
    validation: dict[str, Any] | None = None  # the last record of one
    ended: str | None = None  # why, if the run has ended
    loss: float | None = None  # the last one that was logged
    seconds: dict[str, float] = field(default_factory=dict)  # so far, by what they were spent on

    @property
    def figures(self) -> str:
        """How long training still takes, and its last held-out error, each after a comma."""
        parts = [] if self.left_s is None else [f"{format_span(self.left_s)} left"]
        if (validation := self.validation) is not None:
            error = format_estimate(validation["error"], validation["standard_error"])
            parts.append(f"held-out error {error} on {format_count(validation['held_out'], 'view')}")
        return "".join(f", {part}" for part in parts)

    @property
    def line(self) -> str:
        """All of it in words."""
        steps = count_steps(self.step, self.steps) if self.steps else str(self.step)
        doing = f", {self.phase}" if self.phase and self.phase != TRAINS else ""
        ended = f", ended ({self.ended})" if self.ended else ""
        return f"training {self.run}: step {steps}{doing}{self.figures}{ended}"


def count_steps(step: int, steps: int) -> str:
    """How many of the wanted steps are done; a run that is asked for fewer than it has keeps those that it has."""
    return f"{step}/{steps}" if step <= steps else f"{step} ({steps} wanted)"


class RunFolder:
    """Follows a run's folder: `look` reads only what has been added to its log since the last call."""

    def __init__(self, folder: Path) -> None:
        """Take a folder, which may not exist yet."""
        self.folder = folder
        self.records: list[dict[str, Any]] = []
        self._read_bytes = 0
        self._file = 0  # the log's inode: a trainer that resumes replaces the file

    def look(self) -> TrainingProgress:
        """The present progress."""
        self._read_log()
        said = _read_json(self.folder / PROGRESS)
        if time.time() - said.get("at_s", 0.0) > FRESH_S:
            said = {}
        last = self.records[-1] if self.records else {}
        losses = [each.get("loss") for each in self.records if each.get("kind") == "train"]
        return TrainingProgress(
            self.folder.name,
            max(_number(last.get("step")), _number(said.get("step"))),
            _number(said.get("steps")) or _number(_read_json(self.folder / SETTINGS).get("max_steps")),
            said.get("phase"),
            said.get("left_s"),
            next((each for each in reversed(self.records) if each.get("kind") == "validation"), None),
            str(last.get("reason")) if last.get("kind") == "end" and not said else None,
            next((loss for loss in reversed(losses) if isinstance(loss, float) and math.isfinite(loss)), None),
            next((each["seconds"] for each in reversed(self.records) if isinstance(each.get("seconds"), dict)), {}),
        )

    @property
    def steps_between(self) -> int:
        """The steps between two validations; 0: not known."""
        return _number(_read_json(self.folder / SETTINGS).get("validate_every"))

    def _read_log(self) -> None:
        try:
            with (self.folder / METRICS).open("rb") as file:
                about = os.fstat(file.fileno())
                if about.st_ino != self._file or about.st_size < self._read_bytes:
                    self.records, self._read_bytes, self._file = [], 0, about.st_ino
                file.seek(self._read_bytes)
                added = file.read()
        except OSError:
            return
        whole = added[: added.rfind(b"\n") + 1]
        self._read_bytes += len(whole)
        self.records += [record for line in whole.splitlines() if (record := _record(line))]


def begun_on(run: Path) -> str | None:
    """The id of the scene that a run was begun on; None for a new run, or one whose damage the trainer tells."""
    for name in (INITIAL, CHECKPOINT):
        try:
            with (run / name).open("rb") as file:
                length = int.from_bytes(file.read(8), "little")
                header = json.loads(file.read(min(length, MOST_HEADER_BYTES)))
            return str(json.loads(header["__metadata__"][METADATA])["scene_id"])
        except (OSError, ValueError, LookupError, TypeError):
            continue
    return None


def hold_out_of(run: Path) -> float | None:
    """The share that a run holds out, which it keeps for ever; None for a new run."""
    try:
        return float(_read_json(run / SETTINGS)["hold_out"])
    except (ValueError, LookupError, TypeError):  # none, or one whose fault the trainer tells
        return None


def check_run(run: Path, spec: SceneSpec, store: str | Path) -> None:
    """Raise SpecError if a run's folder is of another scene: its trainer would refuse to go on with this one."""
    scene_id = begun_on(run)
    if scene_id is None or scene_id == spec.scene_id:
        return
    begun = f"scene {scene_id}"
    with suppress(StoreError):
        if (opened := Store(store)).has_scene(scene_id):
            begun = f"{opened.scene(scene_id).spec.name} (scene {scene_id})"
    raise SpecError(
        f"--run {run}: was trained on {begun}, and {spec.name} (scene {spec.scene_id}) is asked for; name another "
        "folder with --run"
    )


def _record(line: bytes) -> dict[str, Any]:
    """A record of the log; empty for a line that is none."""
    try:
        record = json.loads(line)
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}


def _read_json(file: Path) -> dict[str, Any]:
    try:
        return _record(file.read_bytes())
    except OSError:
        return {}


def _number(value: Any) -> int:
    return value if isinstance(value, int) else 0
