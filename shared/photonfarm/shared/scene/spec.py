"""The scene spec: what to render and what may change, as frozen models read from a `scene.toml`.

Lengths are in scene units, angles in degrees. The spec's content digest, with the bytes of every file the scene is made
of, is the scene id: equal content gives equal ids on every machine, wherever the files lie.
"""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.keys import make_key
from photonfarm.shared.scene import files as scene_files

Vector = tuple[float, float, float]
Probability = Annotated[float, Field(ge=0, le=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=64)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Factor = Annotated[float, Field(ge=0, allow_inf_nan=False)]

BUILTIN_ROOMS = ("cornell", "room")
SCENES_VARIABLE = "PHOTONFARM_SCENES"
INPUT_SHOWN = 100
"""The most characters of a wrong value that a message repeats, as the value may be a whole file."""
FEW = 3
"""Up to so many lights, a message about an unknown light names them all."""


class Frozen(BaseModel):
    """A model that cannot change and refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Box(Frozen):
    """An axis-aligned box; it may be flat in any axis."""

    min: Vector
    max: Vector

    @model_validator(mode="after")
    def _is_not_inverted(self) -> Self:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if low > high:
                raise ValueError(f"is inverted along {axis}: min {low} is above max {high}; min ≤ max is required")
        return self

    @property
    def low(self) -> NDArray[np.float64]:
        """The lower corner, (3,)."""
        return np.array(self.min)

    @property
    def high(self) -> NDArray[np.float64]:
        """The upper corner, (3,)."""
        return np.array(self.max)


class Movable(Frozen):
    """Shapes that move and vanish as one: `at` is a fixed point of them, placed uniformly in `box`."""

    name: Name
    shapes: tuple[str, ...] = Field(min_length=1)
    at: Vector  # where the reference point stands in the scene as modelled
    box: Box  # where the reference point may stand
    removal_probability: Probability = 0.2


class Rectangle(Frozen):
    """A rectangular ceiling light that the spec adds to the scene, facing down the world's up axis."""

    size: tuple[Positive, Positive]  # along the two horizontal axes, in their order
    radiance: tuple[float, float, float]

    @model_validator(mode="after")
    def _emits(self) -> Self:
        if min(self.radiance) < 0 or max(self.radiance) == 0:
            raise ValueError(f"has radiance {self.radiance}; all ≥ 0 and one > 0 are required")
        return self


class Light(Movable):
    """A movable light: emitting shapes of the scene, or a rectangle that the spec adds."""

    shapes: tuple[str, ...] = ()
    rectangle: Rectangle | None = None
    removal_probability: Probability = 0.0

    @model_validator(mode="after")
    def _is_one_or_the_other(self) -> Self:
        if bool(self.shapes) == (self.rectangle is not None):
            raise ValueError("needs either shapes (of the scene) or a rectangle (to add), and not both")
        return self

    @property
    def shape_ids(self) -> tuple[str, ...]:
        """The ids of its shapes in the loaded scene."""
        return self.shapes or (self.name,)


class Source(Frozen):
    """Where the scene comes from: a Mitsuba scene file, or a built-in room."""

    file: str | None = None  # beside the spec, or under a folder of PHOTONFARM_SCENES
    builtin: Literal["cornell", "room"] | None = None
    parameters: dict[str, str] = {}  # values for the scene file's own <default> names

    @model_validator(mode="after")
    def _is_one_or_the_other(self) -> Self:
        if (self.file is None) == (self.builtin is None):
            raise ValueError(f"needs either file (a Mitsuba scene) or builtin (one of {', '.join(BUILTIN_ROOMS)})")
        return self


class ViewSpec(Frozen):
    """The boxes that views are drawn from, and the camera's constants."""

    origin: Box
    look_at: Box
    fov_deg: Annotated[float, Field(ge=1, le=170)] = 60.0  # along the image's width
    up: Vector = (0.0, 1.0, 0.0)
    near: Positive = 0.01  # also the near plane of window depth
    far: Positive = 1000.0

    @model_validator(mode="after")
    def _is_a_camera(self) -> Self:
        if self.near >= self.far:
            raise ValueError(f"has near {self.near} ≥ far {self.far}; near < far is required")
        if sorted(map(abs, self.up)) != [0, 0, 1]:
            raise ValueError(f"has up {self.up}; a unit vector along one axis is required")
        if self.origin == self.look_at and self.origin.min == self.origin.max:
            raise ValueError("has origin and look_at in one and the same point; no direction can be drawn")
        return self


class Film(Frozen):
    """The image's size in pixels; divisible by 8, as the image synthesis layer halves it three times."""

    width: Annotated[int, Field(ge=8, le=4096, multiple_of=8)] = 128
    height: Annotated[int, Field(ge=8, le=4096, multiple_of=8)] = 128


class Transport(Frozen):
    """Light transport: the settings of the `bdpt` integrator."""

    max_depth: Annotated[int, Field(ge=-1, le=64)] = 8  # edges of a path; 1: only emitters seen directly; -1: no limit
    rr_depth: Annotated[int, Field(ge=1)] = 5  # path length from which Russian roulette may end it
    connections: Annotated[int, Field(ge=0, le=64)] = 1  # light vertices joined to each eye vertex
    light_ratio: Annotated[float, Field(ge=0, le=64)] = 1.0  # light paths per eye path
    half_spp: Annotated[int, Field(ge=1, le=65536)] = 4  # samples per pixel of each of the two half-estimates

    @model_validator(mode="after")
    def _has_light_paths_to_connect_to(self) -> Self:
        if self.connections and not self.light_ratio:
            raise ValueError(
                f"has connections = {self.connections} and light_ratio = 0; light_ratio = 0 has no light paths to "
                "connect to, so connections = 0 or a light_ratio above 0 is required"
            )
        return self


class PhotonSpec(Frozen):
    """Light sub-paths stored per modification: `paths` × `depth` slots; 0 paths: none."""

    paths: Annotated[int, Field(ge=0, le=1 << 20)] = 1024
    depth: Annotated[int, Field(ge=1, le=16)] = 4

    @property
    def slots(self) -> int:
        """Photons stored per modification, K; empty slots count."""
        return self.paths * self.depth


class GuideSpec(Frozen):
    """The settings of the guides, which are rendered beside each view's buffers; no sample depends on them."""

    light_samples: Annotated[int, Field(ge=0, le=64)] = 3  # shadow rays of each of a pixel's 16 sub-pixels; 0: none


class Emitters(Frozen):
    """Factors on the radiance of the scene's own lights: those of its file or built-in room that no `Light` moves."""

    all: Factor = 1.0  # for every light: 0 switches it off
    by_id: dict[str, Factor] = {}  # for single lights instead, by the id of their shape, or "environment"

    @model_validator(mode="before")
    @classmethod
    def _has_ids_in_their_place(cls, said: Any) -> Any:
        beside = [key for key in said if key not in cls.model_fields] if isinstance(said, Mapping) else []
        if beside:
            raise ValueError(f"has the key {beside[0]!r}; factors of single lights go under by_id = {{ id = factor }}")
        return said

    def factor(self, name: str) -> float:
        """The factor of one light, by its id."""
        return self.by_id.get(name, self.all)

    def __str__(self) -> str:
        """All factors in words."""
        named = [f"{name} × {factor:g}" for name, factor in self.by_id.items()]
        return ", ".join([*named, f"{'all others' if named else 'all'} × {self.all:g}"])


class Credits(Frozen):
    """The authorship and licence of a scene; they go with the data, into reports."""

    title: Annotated[str, Field(min_length=1, max_length=200)]
    author: Annotated[str, Field(min_length=1, max_length=200)]
    licence: Annotated[str, Field(min_length=1, max_length=200)]  # such as CC0-1.0 or CC-BY-3.0
    source: Annotated[str, Field(max_length=500)] = ""  # where it was published


class SceneSpec(Frozen):
    """A scene and everything that shapes its samples. No movable group: a static scene."""

    name: Name
    credits: Credits | None = None  # None: not given
    scene: Source
    objects: tuple[Movable, ...] = ()
    lights: tuple[Light, ...] = ()
    emitters: Emitters = Field(default=Emitters(), exclude_if=lambda said: said == Emitters())  # then left out of ids
    view: ViewSpec
    film: Film = Film()
    transport: Transport = Transport()
    photons: PhotonSpec = PhotonSpec()
    guides: GuideSpec = GuideSpec()
    points: Annotated[int, Field(ge=1, le=1 << 22)] = 16384  # size of the base point cloud
    exposure: Positive = 1.0  # fixed factor on linear radiance, for losses and pictures
    content: str = ""  # digest of the scene's files; set when loaded

    @model_validator(mode="after")
    def _groups_are_distinct(self) -> Self:
        names = [group.name for group in self.groups]
        shapes = [shape for group in self.groups for shape in shape_ids(group)]
        for what, found in (("group name", names), ("shape id", shapes)):
            twice = sorted({x for x in found if found.count(x) > 1})
            if twice:
                raise ValueError(f"uses {what} {twice[0]!r} twice; each may belong to one movable group")
        return self

    @property
    def groups(self) -> tuple[Movable, ...]:
        """Every movable group, objects before lights: the order of the modification vector."""
        return self.objects + self.lights

    @cached_property
    def scene_id(self) -> str:
        """32 hexadecimal digits: the digest of all that a sample's radiance depends on."""
        not_of_it: dict[str, Any] = {"scene": {"file"}, "name": True, "credits": True, "guides": True}
        described = self.model_dump(mode="json", exclude=not_of_it)
        return make_key("scene", _canonical(described)).hex()

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A changed copy; pydantic would keep the id of the original."""
        copied = super().model_copy(update=update, deep=deep)
        copied.__dict__.pop("scene_id", None)
        return copied

    @property
    def radiance_exponent(self) -> int:
        """The power of two that stored radiance is multiplied by, so that exposed values lie near 1."""
        return int(np.round(np.log2(self.exposure)))


def shape_ids(group: Movable) -> tuple[str, ...]:
    """The ids of a group's shapes in the loaded scene."""
    return group.shape_ids if isinstance(group, Light) else group.shapes


def _canonical(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ",".join(f"{k}:{_canonical(value[k])}" for k in sorted(value)) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(_canonical, value)) + "]"
    return repr(value)


# ---------------------------------------------------------------------------------------------------------------------


def load_spec(path: str | Path) -> SceneSpec:
    """The checked spec in a file, TOML or, as stores have it, JSON.

    A bare name such as `room` is looked up among the built-in and ready specs.

    Raises SpecError with one sentence that names the key, the value and the rule.
    """
    file = find_spec(str(path))
    parse, language = (json.loads, "JSON") if file.suffix == ".json" else (tomllib.loads, "TOML")
    try:
        described = parse(file.read_text(encoding="utf-8-sig"))  # with or without a byte-order mark
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(f"{file}: cannot be read: {error}") from error
    except ValueError as error:
        raise SpecError(f"{file}: is not valid {language}: {error}") from error
    return parse_spec(described, where=str(file), beside=file.parent)


def parse_spec(described: dict[str, Any], *, where: str, beside: Path | None = None) -> SceneSpec:
    """The checked spec in a parsed TOML or JSON document, its scene file found and digested."""
    spec = _validate({**described, "content": ""}, where)
    if spec.scene.file is None:
        content = f"builtin {spec.scene.builtin} {scene_files.BUILTIN_REVISION}"
        known = scene_files.BUILTIN_SHAPES[str(spec.scene.builtin)]
        _check_shapes(spec, known, where)
        _check_emitters(spec, scene_files.BUILTIN_EMITTING[str(spec.scene.builtin)], known, where)
    else:
        scene = scene_files.SceneFile.read(find_scene(spec.scene.file, where, beside))
        content = scene.digest
        _check_shapes(spec, scene.shape_ids, where)
        _check_lights(spec, scene.emitting, where)
        _check_emitters(spec, scene.emitting | scene.shapeless, scene.shape_ids, where)
    return spec.model_copy(update={"content": content})


def _validate(described: dict[str, Any], where: str) -> SceneSpec:
    try:
        return SceneSpec.model_validate(described)
    except ValidationError as error:
        raise SpecError(f"{where}: {'; '.join(sentences(error, _keys(SceneSpec)))}") from error


def sentences(error: ValidationError, known: Iterable[str] = ()) -> Iterator[str]:
    """One sentence for each fault that a model found: its key, the value and the rule; `known` are the allowed keys."""
    for fault in error.errors():
        key = ".".join(map(str, fault["loc"]))
        rule = fault["msg"].removeprefix("Value error, ")
        if not key:  # of the whole
            yield rule
        elif fault["type"] in ("value_error", "missing"):
            yield f"{key}: {rule}"
        elif fault["type"] == "extra_forbidden":
            yield f"{key}: unknown key; nearest: {scene_files.nearest(str(fault['loc'][-1]), known)}"
        else:
            yield f"{key} = {_shortened(repr(fault['input']))}: {rule}"


def _shortened(text: str) -> str:
    return text if len(text) <= INPUT_SHOWN else f"{text[:INPUT_SHOWN]}…"


def _keys(model: type[BaseModel]) -> set[str]:
    """The keys of a model and of those in it."""
    schema = model.model_json_schema()
    return {key for part in (schema, *schema.get("$defs", {}).values()) for key in part.get("properties", ())}


def _check_shapes(spec: SceneSpec, known: frozenset[str], where: str) -> None:
    for group in spec.groups:
        for shape in group.shapes:
            if shape not in known:
                near = scene_files.nearest(shape, known)
                raise SpecError(
                    f"{where}: {group.name}.shapes: {shape!r} is not a shape id of the scene; nearest: {near}"
                )
        if isinstance(group, Light) and group.rectangle and group.name in known:
            raise SpecError(f"{where}: light {group.name!r} adds a rectangle under an id that the scene already has")


def _check_lights(spec: SceneSpec, emitting: frozenset[str], where: str) -> None:
    for light in spec.lights:
        if light.shapes and not emitting.intersection(light.shapes):
            raise SpecError(
                f"{where}: {light.name}.shapes: none of {', '.join(light.shapes)} emits light in the scene; what only "
                "moves belongs under [[objects]]"
            )


def _check_emitters(spec: SceneSpec, emitting: frozenset[str], shapes: frozenset[str], where: str) -> None:
    moved = {shape: light for light in spec.lights for shape in light.shape_ids}
    for name in spec.emitters.by_id:
        if name in moved:
            remedy = "its rectangle has a radiance" if moved[name].rectangle else "to dim it, take it out of [[lights]]"
            fault = f"is of the movable light {moved[name].name!r}, and factors are of lights that no [[lights]] moves"
            raise SpecError(f"{where}: emitters.by_id: {name!r} {fault}; {remedy}")
        if name not in emitting:
            fault = "is a shape that emits no light" if name in shapes else "is no light of the scene"
            own = emitting - set(moved)
            near = ", ".join(sorted(own)) if 0 < len(own) <= FEW else scene_files.nearest(name, own)
            raise SpecError(f"{where}: emitters.by_id: {name!r} {fault}; nearest light: {near}")


def find_scene(file: str, where: str, beside: Path | None = None) -> Path:
    """The scene file named in a spec: absolute, beside the spec, or under a folder of PHOTONFARM_SCENES."""
    if Path(file).is_absolute() and Path(file).is_file():
        return Path(file)
    folders = [beside] if beside else []
    folders += [Path(p) for p in os.environ.get(SCENES_VARIABLE, "").split(os.pathsep) if p]
    for folder in folders:
        if (folder / file).is_file():
            return folder / file
    looked = ", ".join(map(str, folders)) or "nowhere"
    raise SpecError(
        f"{where}: scene.file = {file!r} is not there (looked in: {looked}); "
        f"set {SCENES_VARIABLE} to the folder that holds it"
    )


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
    raise SpecError(f"{name}: no such spec; give a .toml file or one of {', '.join(known)}")


@dataclass(frozen=True, slots=True)
class NamedSpec:
    """A checked spec under the name that a user gives it."""

    name: str  # as `load_spec` takes it
    spec: SceneSpec
    scenes: str | None
    """The folder that workers must have in PHOTONFARM_SCENES, if the scene file is found beside the spec alone: workers
    have the store, and not the spec's file."""

    @classmethod
    def load(cls, name: str) -> Self:
        """The spec of a name, as `load_spec` reads it; raises SpecError."""
        spec = load_spec(name)
        if spec.scene.file is not None:
            try:
                find_scene(spec.scene.file, name)
            except SpecError:
                return cls(name, spec, str(find_spec(name).absolute().parent))
        return cls(name, spec, None)
