"""Cameras and configurations that are read from files: `transforms.json`, and JSON or CSV by the names of groups."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.core.errors import SpecError
from photonfarm.core.formatting import format_count
from photonfarm.scene.arrangement import Arrangement, Shot
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View, sample_view

FOV_SLACK_DEG, ROLL_SLACK_DEG = 0.05, 0.5
"""How far a camera may be from the spec's field of view, and from one that stands upright."""

COLOURS = ("red", "green", "blue")

OF_GROUPS = ("x", "y", "z", "present", "turn", "power", *COLOURS)
"""What columns say of a group, as NAME.x."""

COLUMN = re.compile(rf"[^;]+\.({'|'.join(OF_GROUPS)})|fov")
"""The names of columns."""

DISTORTED = ("k1", "k2", "k3", "k4", "p1", "p2")
"""The coefficients of lenses, which must be 0."""


def read_shots(
    spec: SceneSpec,
    cameras: Path | None,
    configurations: Path | None,
    start: Modification | None = None,
    *,
    views: int = 1,
    seed: int = 0,
    otherwise: View | None = None,
    fov: float | None = None,
) -> list[tuple[Modification, View]]:
    """The views of a spec that two files say, each with its configuration.

    Configurations change `start`, by default the scene at rest, which is the only one without their file. Each is seen
    by its own camera if it has one, else by all `cameras`; without that file from one view `otherwise`, or else by so
    many random `views`, of a master seed. `fov`, in degrees, is that of cameras of which no file says it, by default
    the spec's. Raises SpecError for what is no such file, and for what the spec cannot have.
    """
    seen_by = read_cameras(cameras, spec, fov) if cameras else [otherwise] if otherwise else []
    start = rest(spec) if start is None else start
    arranged = [(start, None)] if configurations is None else read_configurations(configurations, spec, start, fov)
    shots: list[tuple[Modification, View]] = []
    for modification, own in arranged:
        key = modification.key(spec.radiance_id)
        drawn = () if own or seen_by else (sample_view(spec, key, seed, i, modification) for i in range(views))
        shots += [(modification, view) for view in ([own] if own else [*seen_by, *drawn])]
    return shots


def name_frames(doubts: Sequence[Iterable[str]], first: int = 0) -> list[str]:
    """The doubts about several shots, from the `first` on, each once, after the name that `infer` gives their frame.

    A shot that is alone has no name.
    """
    found: dict[str, list[str]] = {}
    for number, of_shot in enumerate(doubts, first):
        for doubt in of_shot:
            found.setdefault(doubt, []).append(f"frame-{number:04}")
    if first + len(doubts) == 1:
        return [*found]
    more = {doubt: f" and {len(names) - 1} more" if len(names) > 1 else "" for doubt, names in found.items()}
    return [f"{names[0]}{more[doubt]}: {doubt}" for doubt, names in found.items()]


# -------------------------------------------------------------------------------------------------------------- cameras


def read_cameras(file: Path, spec: SceneSpec, fov: float | None = None) -> list[View]:
    """The views in a `transforms.json`, as nerfstudio and `photonfarm export --to exr` write it.

    Its world is the scene's, and each has its field of view, `fov` where it is not said. Raises SpecError for a camera
    that is not upright, or has another aspect, or a lens that distorts.
    """
    document = _read_json(file)
    frames = document.get("frames") if isinstance(document, Mapping) else None
    if not isinstance(frames, list) or not frames:
        raise SpecError(f"{file}: has no frames; a transforms.json has a list of them, each with a transform_matrix")
    count = len(frames)
    return [
        _read_camera(document, frame, spec, fov, f"{file}: frame {n} of {count}") for n, frame in enumerate(frames, 1)
    ]


def _read_camera(document: Mapping[str, Any], frame: Any, spec: SceneSpec, fov: float | None, where: str) -> View:
    """The view of a frame, with what is said of all frames; its own `look_at` if it has one."""
    try:
        camera = {**document, **frame}
        to_world = np.array(camera["transform_matrix"], np.float64)[:3, :4]
        fov_deg = _read_fov(camera)
        lens = [float(camera.get(name, 0)) for name in DISTORTED]
        aspect = float(camera.get("w", spec.film.width)) / float(camera.get("h", spec.film.height))
        look_at = camera.get("look_at")
    except (KeyError, TypeError, ValueError, IndexError, ZeroDivisionError) as error:
        raise SpecError(f"{where}: is no camera: {error!r}; a transform_matrix of 4 × 4 numbers is required") from error
    if to_world.shape != (3, 4) or not (np.isfinite(to_world).all() and to_world[:, :3].any(axis=0).all()):
        raise SpecError(f"{where}: transform_matrix: 4 × 4 finite numbers are required, of a rotation and a place")
    if fov_deg is not None and spec.view.fov is None and abs(fov_deg - spec.view.fov_deg) <= FOV_SLACK_DEG:
        fov_deg = spec.view.fov_deg
    if abs(aspect - spec.film.width / spec.film.height) > 1e-3 * aspect:
        raise SpecError(f"{where}: its image is {aspect:.3f} times as wide as high, and the spec's film is not")
    if any(lens):
        raise SpecError(f"{where}: has a lens that distorts; undistort its images, and give their cameras")
    right, _, backward, origin = to_world.T
    if look_at is None:  # the point ahead that is nearest to the middle of what is looked at
        middle = 0.5 * (spec.view.look_at.low + spec.view.look_at.high)
        ahead = -backward / np.linalg.norm(backward)
        distance = float((middle - origin) @ ahead)
        look_at = origin + ahead * (distance if distance > spec.view.near else 1.0)
    try:
        view = Shot.of(camera=origin, look_at=look_at, fov=fov if fov_deg is None else fov_deg).view(spec)
    except SpecError as error:
        raise SpecError(f"{where}: {error}") from error
    made = Camera.of(view, spec)
    off = max(_angle_between(made.right, right), _angle_between(-made.forward, backward))
    if off > ROLL_SLACK_DEG:
        raise SpecError(
            f"{where}: is turned by {off:.1f}° about its axis; cameras of this spec are upright, by view.up"
        )
    return view


def _read_fov(camera: Mapping[str, Any]) -> float | None:
    """The field of view along the width, in degrees; None if it is not said."""
    if "fl_x" in camera and "w" in camera:
        return float(np.degrees(2 * np.arctan(0.5 * float(camera["w"]) / float(camera["fl_x"]))))
    return float(np.degrees(float(camera["camera_angle_x"]))) if "camera_angle_x" in camera else None


def _angle_between(one: Any, other: Any) -> float:
    """The angle between two directions, in degrees."""
    cosine = float(one @ other) / (float(np.linalg.norm(one)) * float(np.linalg.norm(other)))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


# ------------------------------------------------------------------------------------------------------- configurations


def read_configurations(
    file: Path, spec: SceneSpec, start: Modification | None = None, fov: float | None = None
) -> list[tuple[Modification, View | None]]:
    """The configurations in a file, by names, as changes of `start`, each with its camera if it has one of its own.

    JSON is a table with the fields of a `Shot`, as `photonfarm infer` writes it, or a list. CSV has a column for each
    number: `sofa.x`, `sofa.y` and `sofa.z` are where that stands, `sofa.present` is 0 where it is not there,
    `sofa.turn`, `lamp.power`, `lamp.red`, `lamp.green`, `lamp.blue` are as the modification vector has them, `camera.x`
    … `look_at.z` and `fov` the camera's; an empty cell changes nothing.
    """
    is_table = file.suffix.lower() == ".csv"
    entries = dict(_read_table(file) if is_table else _read_list(file))
    if not entries:
        raise SpecError(f"{file}: has no configurations")
    found: list[tuple[Modification, View | None]] = []
    for where, entry in entries.items():
        try:
            shot = Shot.of(**{"fov": fov} | (_fill_places(entry, spec, start) if is_table else entry))
            is_own = shot.camera or shot.look_at or (shot.fov or spec.view.fov_deg) != (fov or spec.view.fov_deg)
            own = shot.view(spec) if is_own else None
            found.append((shot.apply(spec, start), own))
        except SpecError as error:
            raise SpecError(f"{file}: {where}: {error}") from error
    return found


def _read_list(file: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """The tables of a JSON file, each with where it stands; of what `infer` wrote, which names a scene, the shot."""
    document = _read_json(file)
    entries = document if isinstance(document, list) else [document]
    if not all(isinstance(entry, dict) for entry in entries):
        raise SpecError(f"{file}: a list of tables is required, each with place, move, without, camera or look_at")
    for number, entry in enumerate(entries, 1):
        read = {*Shot.model_fields} if "scene" in entry else {*entry}
        yield f"configuration {number} of {len(entries)}", {key: entry[key] for key in entry if key in read}


def _read_json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SpecError(f"{file}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise SpecError(f"{file}: is not valid JSON: {error}") from error


def _read_table(file: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """The rows of a CSV file, by names and coordinates, each with its line; the first line has the names."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as lines:
            rows = csv.reader(lines)
            names = [name.strip() for name in next(rows, [])]
            for number, name in enumerate(names):
                _check_column(file, name, names[:number])
            for row in filter(None, rows):
                where = f"line {rows.line_num}"
                if len(row) != len(names):
                    cells = format_count(len(row), "cell")
                    raise SpecError(f"{file}: {where}: has {cells}, and the first line has {len(names)} names")
                yield (
                    where,
                    {name: cell.strip() for name, cell in zip(names, row, strict=True) if name and cell.strip()},
                )
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SpecError(f"{file}: cannot be read: {error}") from error


def _check_column(file: Path, name: str, before: Sequence[str]) -> None:
    """Raise SpecError for a column that means nothing, or is there twice; those without a name are not read."""
    if ";" in name:
        raise SpecError(f"{file}: line 1: semicolons are between the columns; commas are required, and decimal points")
    if name and not COLUMN.fullmatch(name):
        known = ", ".join(f"NAME.{what}" for what in OF_GROUPS)
        raise SpecError(f"{file}: line 1: column {name!r}: is none of {known}, camera.x … look_at.z, fov")
    if name and name in before:
        raise SpecError(f"{file}: line 1: column {name!r}: is there twice")


def _fill_places(cells: Mapping[str, str], spec: SceneSpec, start: Modification | None) -> dict[str, Any]:
    """The cells of a row as a `Shot` has them; what they do not say of a group that they name is as at the start."""
    before = Arrangement.from_modification(spec, rest(spec) if start is None else start)
    at = {group.name: group.at for group in spec.groups} | before.place
    entry: dict[str, Any] = {"place": {}, "colour": {}, "turn": {}, "power": {}, "without": []}
    for key, cell in cells.items():
        name, _, what = key.rpartition(".")
        number = _read_number(key, cell)
        if name in ("camera", "look_at") and what in ("x", "y", "z"):
            entry.setdefault(name, [None, None, None])["xyz".index(what)] = number
        elif name and what == "present" and number == 0:
            entry["without"] += [name]
        elif name and what in ("x", "y", "z", "present"):
            place = entry["place"].setdefault(name, [*at.get(name, (0.0, 0.0, 0.0))])
            if what != "present":
                place["xyz".index(what)] = number
        elif name and what in COLOURS:
            entry["colour"].setdefault(name, [*before.colour.get(name, (1.0, 1.0, 1.0))])[COLOURS.index(what)] = number
        elif name and what in ("turn", "power"):
            entry[what][name] = number
        else:
            entry["fov"] = number
    for name in ("camera", "look_at"):
        if empty := [f"{name}.{x}" for x, number in zip("xyz", entry.get(name, ()), strict=False) if number is None]:
            raise SpecError(f"{' and '.join(empty)} {'is' if len(empty) == 1 else 'are'} empty; a point has all three")
    for changes in ("place", "colour", "turn", "power"):
        entry[changes] = {name: value for name, value in entry[changes].items() if name not in entry["without"]}
    return entry


def _read_number(key: str, cell: str) -> float:
    try:
        return float(cell)
    except ValueError as error:
        raise SpecError(f"column {key!r}: {cell!r} is no number") from error
