"""Spec files: found by name, read, and checked against the scene file that they name."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pydantic import BaseModel, ValidationError

from photonfarm.core.errors import SceneNotHereError, SpecError
from photonfarm.core.models import nearest, sentences
from photonfarm.scene.files import BUILTIN, SceneFile, check_textures
from photonfarm.scene.groups import Light
from photonfarm.scene.spec import SceneSpec

SCENES_VARIABLE = "PHOTONFARM_SCENES"
SCENE_SUFFIXES = (".xml", ".gltf", ".glb", ".obj", ".blend", ".usd", ".usda", ".usdc", ".usdz", ".fbx")
"""What `photonfarm scene import` takes."""

FEW = 3
"""Up to so many lights, a message about an unknown light names them all."""


def load_spec(path: str | Path, *, measured_again: bool = False) -> SceneSpec:
    """The checked spec in a file, TOML or, as stores have it, JSON.

    A bare name such as `room` is looked up among the built-in and ready specs. With `measured_again` it is without free
    space, which is measured anew.

    Raises SpecError with one sentence that names the key, the value and the rule.
    """
    return _read(find_spec(str(path)), measured_again=measured_again)[0]


def _read(file: Path, *, measured_again: bool = False) -> tuple[SceneSpec, frozenset[str]]:
    """The checked spec in a file, and the ids of its scene's lights."""
    if file.suffix.lower() in SCENE_SUFFIXES:
        raise SpecError(f"{file}: is a scene and no spec; `photonfarm scene import {file}` makes a spec of it")
    parse, language = (json.loads, "JSON") if file.suffix == ".json" else (tomllib.loads, "TOML")
    try:
        described = parse(file.read_text(encoding="utf-8-sig"))  # with or without a byte-order mark
    except OSError as error:
        raise SpecError(f"{file}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise SpecError(f"{file}: is no spec, or not saved as UTF-8: byte {error.start} is no text") from error
    except ValueError as error:
        raise SpecError(f"{file}: is not valid {language}: {error}") from error
    if not isinstance(described, dict):
        raise SpecError(f"{file}: holds a {type(described).__name__}; the tables of a spec are required")
    if measured_again and isinstance(view := described.get("view"), dict):
        view.pop("free_space", None)
    return parse_with_lights(described, where=str(file), beside=file.parent)


def parse_spec(described: dict[str, Any], *, where: str, beside: Path | None = None) -> SceneSpec:
    """The checked spec in a parsed TOML or JSON document, its scene file found and digested."""
    return parse_with_lights(described, where=where, beside=beside)[0]


def locate(spec: SceneSpec) -> SceneSpec:
    """The spec, once its scene file has been found on this machine and is the planned one.

    Raises SceneNotHereError otherwise: other machines may still render the job.
    """
    try:
        here = parse_spec(spec.model_dump(mode="json"), where=f"scene {spec.scene_id} ({spec.name})")
    except SpecError as error:
        raise SceneNotHereError(f"this machine cannot render {error}") from error
    if here.scene_id != spec.scene_id:
        raise SceneNotHereError(
            f"scene {spec.scene_id} ({spec.name}): the scene file here is another one than was planned (its files' "
            f"digest is {here.content[:12]}…, planned was {spec.content[:12]}…); give every worker the same files"
        )
    return here


def parse_with_lights(
    described: dict[str, Any], *, where: str, beside: Path | None = None
) -> tuple[SceneSpec, frozenset[str]]:
    """What `parse_spec` gives, and the ids of the scene's own lights; "" stands for those that have none."""
    described = {**described, "content": ""}
    try:
        spec = SceneSpec.model_validate(described)
    except ValidationError as error:
        raise SpecError(f"{where}: {'; '.join(sentences(error, _keys(SceneSpec), described))}") from error
    source = spec.scene
    scene = (
        BUILTIN[str(source.builtin)] if source.file is None else SceneFile.read(find_scene(source.file, where, beside))
    )
    _check_shapes(spec, scene, where)
    _check_emitters(spec, scene, where)
    spec = spec.model_copy(update={"content": scene.digest})
    if spec.view.free_space is not None and spec.view.free_space.of != spec.free_space_digest:
        raise SpecError(
            f"{where}: view.free_space: was measured for other files of the scene (meshes or textures), groups or "
            f"boxes of views; `photonfarm scene free-space {where} --write` measures it again"
        )
    return spec, scene.lights


def _keys(model: type[BaseModel]) -> dict[str, str]:
    """The keys of a model and of those in it, each with the outermost tables that have it; "" if none of them does."""
    schema = model.model_json_schema()
    tables = {name: part.get("properties", {}) for name, part in schema["$defs"].items()}
    places: dict[str, list[str]] = {key: [] for keys in (schema["properties"], *tables.values()) for key in keys}
    for outer, of in schema["properties"].items():
        places[outer].append("above all tables")
        for kind in re.findall(r"#/\$defs/(\w+)", json.dumps(of)):
            for key in tables[kind]:
                places[key].append(f"in [[{outer}]]" if of.get("type") == "array" else f"in [{outer}]")
    return {key: " or ".join(found) for key, found in places.items()}


def _check_shapes(spec: SceneSpec, scene: SceneFile, where: str) -> None:
    """Raise SpecError for a group of shapes that the scene has not, and for a light of shapes that are none."""
    for group in spec.groups:
        for shape in group.shapes:
            if isinstance(group, Light) and shape in scene.shapeless:
                if not group.stays:
                    raise SpecError(
                        f"{where}: {group.name}.shapes: {shape!r} has no shape to move; leave out at and box"
                    )
            elif shape not in scene.shape_ids:
                fault = f"{where}: {group.name}.shapes: {shape!r} is not a shape id of the scene"
                if not scene.shape_ids:
                    raise SpecError(f"{fault}: its shapes have no ids; `photonfarm scene import` makes a copy with ids")
                raise SpecError(f"{fault}; nearest: {nearest(shape, scene.shape_ids)}")
    for light in spec.lights:
        if light.rectangle and light.name in scene.shape_ids:
            raise SpecError(f"{where}: light {light.name!r} adds a rectangle under an id that the scene already has")
        if light.shapes and not (scene.emitting | scene.shapeless).intersection(light.shapes):
            raise SpecError(
                f"{where}: {light.name}.shapes: none of {', '.join(light.shapes)} emits light in the scene; what only "
                "moves belongs under [[objects]]"
            )


def _check_emitters(spec: SceneSpec, scene: SceneFile, where: str) -> None:
    """Raise SpecError for a factor of what is no light of the scene's own."""
    moved = {shape: light for light in spec.lights for shape in light.shape_ids}
    lights = scene.emitting | scene.shapeless
    for name in spec.emitters.by_id:
        if name in moved:
            remedy = "its rectangle has a radiance" if moved[name].rectangle else "to dim it, take it out of [[lights]]"
            fault = f"is of the movable light {moved[name].name!r}, and factors are of lights that no [[lights]] moves"
            raise SpecError(f"{where}: emitters.by_id: {name!r} {fault}; {remedy}")
        if name not in lights:
            fault = "is a shape that emits no light" if name in scene.shape_ids else "is no light of the scene"
            own = lights - set(moved)
            near = ", ".join(sorted(own)) if 0 < len(own) <= FEW else nearest(name, own)
            raise SpecError(f"{where}: emitters.by_id: {name!r} {fault}; nearest light: {near}")


def find_scene(file: str, where: str, beside: Path | None = None) -> Path:
    """The scene file named in a spec: absolute, beside the spec, or below PHOTONFARM_SCENES or the current folder.

    The current folder comes last, so that whoever works where `up` did finds what it found.
    """
    if Path(file).is_absolute() and Path(file).is_file():
        return Path(file)
    return _folder_of(file, where, beside) / file


def _folder_of(file: str, where: str, beside: Path | None) -> Path:
    """The folder below which a scene file lies."""
    folders = [*([beside] if beside else []), *_named_folders(), Path()]
    for folder in folders:
        if (folder / file).is_file():
            return folder
    looked = ", ".join(dict.fromkeys(str(folder.absolute()) for folder in folders))
    raise SpecError(
        f"{where}: scene.file = {file!r} is not there (looked in: {looked}); "
        f"set {SCENES_VARIABLE} to the folder that holds it"
    )


def _named_folders() -> list[Path]:
    """The folders of PHOTONFARM_SCENES."""
    return [Path(part) for part in os.environ.get(SCENES_VARIABLE, "").split(os.pathsep) if part]


def scene_folder(name: str, spec: SceneSpec) -> Path | None:
    """The absolute folder below which the scene file of a named spec lies; None if it needs none."""
    file = spec.scene.file
    if file is None or Path(file).is_absolute():
        return None
    return _folder_of(file, name, find_spec(name).parent).absolute()


def find_spec(name: str) -> Path:
    """The file of a spec: a path, or a bare name among `scenes/` here and the built-in ones; else SpecError."""
    path = Path(name)
    if path.suffix == ".toml" or path.is_file():
        return path
    folders = (Path("scenes"), Path(__file__).parent / "specs")
    for folder in folders:
        if (folder / f"{name}.toml").is_file():
            return folder / f"{name}.toml"
    known = sorted({file.stem for folder in folders for file in folder.glob("*.toml")})
    what = "no such spec, as it is a folder" if name and path.is_dir() else "no such spec"
    near = nearest(name, known, least=0.6)
    resembles = "" if near == "none" else f"; nearest: {near}"
    raise SpecError(f"{name or 'an empty name'}: {what}; give a .toml file or one of {', '.join(known)}{resembles}")


@dataclass(frozen=True, slots=True)
class NamedSpec:
    """A checked spec under the name that a user gives it."""

    name: str  # as `load_spec` takes it
    spec: SceneSpec
    scenes: str | None
    """The folder that workers must have in PHOTONFARM_SCENES, if the scene file is found beside the spec alone: workers
    have the store, and not the spec's file."""
    file: Path = Path()
    lights: frozenset[str] = frozenset()  # ids of the scene's own lights; "" stands for those that have none

    @classmethod
    def load(cls, name: str) -> Self:
        """The spec of a name, as `load_spec` reads it, its textures checked; raises SpecError."""
        file = find_spec(name)
        spec, lights = _read(file)
        if spec.scene.file is not None:
            check_textures(find_scene(spec.scene.file, name, file.parent))
        is_found = any((folder / str(spec.scene.file)).is_file() for folder in _named_folders())
        folder = None if is_found else scene_folder(name, spec)
        return cls(name, spec, str(folder) if folder else None, file, lights)


@dataclass(frozen=True, slots=True)
class SpecLines:
    """A spec's file, and the lines on which its keys stand, for messages: `view.origin`, `objects.1.box` → a line."""

    file: Path
    lines: Mapping[str, int]  # from 1; empty for a spec in JSON

    @classmethod
    def of(cls, file: Path) -> Self:
        """The lines of a file that holds a valid spec."""
        return cls(file, lines_of(file.read_text(encoding="utf-8-sig")) if file.suffix == ".toml" else {})

    def line(self, key: str) -> int | None:
        """The line of a key, or of the innermost table around it that the file has; None if it has none."""
        while key and key not in self.lines:
            key = key.rpartition(".")[0]
        return self.lines.get(key)

    def place(self, key: str) -> str:
        """The file, and the line of a key if it has one, in words."""
        line = self.line(key)
        return f"{self.file}" if line is None else f"{self.file} line {line}"


_HEAD = re.compile(r"\s*(\[\[?)\s*([\w.-]+)\s*\]")
_ENTRY = re.compile(r"\s*([\w.-]+)\s*=")


def lines_of(text: str) -> dict[str, int]:
    """The lines of a valid TOML document, from 1, that begin with a table's head, or with a key and its value.

    Elements of arrays of tables are numbered from 0. Python's TOML reader gives no lines.
    """
    lines: dict[str, int] = {}
    counts = Counter[str]()
    table = ""
    for number, line in enumerate(text.splitlines(), 1):
        if head := _HEAD.match(line):
            counts[head[2]] += head[1] == "[["
            path = table = ""
            for part in head[2].split("."):
                path, table = f"{path}.{part}".lstrip("."), f"{table}.{part}".lstrip(".")
                table += f".{counts[path] - 1}" if counts[path] else ""
            lines.setdefault(table, number)
        elif entry := _ENTRY.match(line):
            lines.setdefault(f"{table}.{entry[1]}".lstrip("."), number)
    return lines
