"""The scene spec: what to render and what may change, as frozen models; `spec_loading` reads them from a file.

Lengths are in scene units, angles in degrees. Ids are digests of the spec's content, with the bytes of every file that
the scene is made of: equal content gives equal ids on every machine, wherever the files lie.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from photonfarm.core.keys import make_key
from photonfarm.core.models import Factor, Frozen, Name, Positive
from photonfarm.core.records import Pivots
from photonfarm.scene.free_space import FreeSpace
from photonfarm.scene.groups import Box, Degrees, Fov, Light, Movable, Vector, shape_ids

BUILTIN_ROOMS = ("cornell", "room")


class Source(Frozen):
    """Where the scene comes from: a Mitsuba scene file, or a built-in room."""

    file: str | None = None  # beside the spec, or under a folder of PHOTONFARM_SCENES
    builtin: Literal["cornell", "room"] | None = None
    parameters: dict[str, str] = Field(default_factory=dict)  # values for the scene file's own <default> names

    @model_validator(mode="after")
    def _is_one_or_the_other(self) -> Self:
        if (self.file is None) == (self.builtin is None):
            raise ValueError(f"needs either file (a Mitsuba scene) or builtin (one of {', '.join(BUILTIN_ROOMS)})")
        return self


class ViewSpec(Frozen):
    """The boxes that views are drawn from, and the camera's constants."""

    origin: Box
    look_at: Box
    fov_deg: Degrees = 60.0  # along the image's width
    fov: Fov | None = Field(default=None, exclude_if=lambda said: said is None)  # of each view; then left out of ids
    up: Vector = (0.0, 1.0, 0.0)
    near: Positive = 0.01  # also the near plane of window depth
    far: Positive = 1000.0
    free_space: FreeSpace | None = Field(default=None, exclude_if=lambda said: said is None)  # then left out of ids

    @model_validator(mode="after")
    def _is_a_camera(self) -> Self:
        if self.near >= self.far:
            raise ValueError(f"has near {self.near} ≥ far {self.far}; near < far is required")
        if self.fov and not self.fov.min <= self.fov_deg <= self.fov.max:
            limits = f"{self.fov.min:g} to {self.fov.max:g}"
            raise ValueError(
                f"has fov_deg = {self.fov_deg:g}, of views that say none; within fov, {limits}, is required"
            )
        if sorted(map(abs, self.up)) != [0, 0, 1]:
            raise ValueError(f"has up {self.up}; a unit vector along one axis is required")
        if self.origin == self.look_at and self.origin.min == self.origin.max:
            raise ValueError("has origin and look_at in one and the same point; no direction can be drawn")
        return self

    def describe_fov(self) -> str:
        """The field of view of cameras in words."""
        return f"{self.fov.min:g}° to {self.fov.max:g}°" if self.fov else f"{self.fov_deg:g}°"


class Film(Frozen):
    """The image's size in pixels; divisible by 8, as the image synthesis layer halves it three times."""

    width: Annotated[int, Field(ge=8, le=4096, multiple_of=8)] = 128
    height: Annotated[int, Field(ge=8, le=4096, multiple_of=8)] = 128


class CardStrategy(Frozen):
    """How cards sample light where they do it otherwise than processors; None: as these."""

    rr_depth: Annotated[int, Field(ge=1)] | None = None
    connections: Annotated[int, Field(ge=0, le=64)] | None = None
    light_ratio: Annotated[float, Field(ge=0, le=64)] | None = None
    guided_light: bool | None = None
    light_samples: Annotated[int, Field(ge=1, le=64)] | None = None


class Transport(Frozen):
    """Light transport: the settings of the `bdpt` integrator."""

    max_depth: Annotated[int, Field(ge=-1, le=64)] = 8  # edges of a path; 1: only emitters seen directly; -1: no limit
    rr_depth: Annotated[int, Field(ge=1)] = 5  # edges after which Russian roulette may end any path
    connections: Annotated[int, Field(ge=0, le=64)] = 1  # light vertices joined to each eye vertex
    light_ratio: Annotated[float, Field(ge=0, le=64)] = 1.0  # light paths per eye path
    half_spp: Annotated[int, Field(ge=1, le=65536)] = 4  # samples per pixel of each of the two half-estimates
    guided_light: bool = False  # light paths start where views see them, connections go to useful light vertices
    light_samples: Annotated[int, Field(ge=1, le=64)] = 1  # at the first eye vertex
    card: CardStrategy | None = Field(default=None, exclude_if=lambda said: said is None)

    @model_validator(mode="after")
    def _has_light_paths_to_connect_to(self) -> Self:
        for where, settings in (("", self), ("on cards ", self.on_card)):
            for key, off in (("connections", "0"), ("guided_light", "false")):
                if (value := getattr(settings, key)) and not settings.light_ratio:
                    raise ValueError(
                        f"{where}has {key} = {str(value).lower()} and light_ratio = 0, which has no light paths for "
                        f"it; {key} = {off} or a light_ratio above 0 is required"
                    )
        return self

    @property
    def on_card(self) -> Transport:
        """The settings for cards, with `card` as it is."""
        return self if self.card is None else self.model_copy(update=self.card.model_dump(exclude_none=True))


STRATEGY = frozenset(CardStrategy.model_fields)
"""The settings of `Transport` that change the noise and the cost of an estimate, and not its mean: part of no id."""


class PhotonSpec(Frozen):
    """Light sub-paths stored per modification: `paths` × `depth` slots; 0 paths: none."""

    paths: Annotated[int, Field(ge=0, le=1 << 20)] = 1024
    depth: Annotated[int, Field(ge=1, le=16)] = 4

    @property
    def slots(self) -> int:
        """Photons stored per modification, K; empty slots count."""
        return self.paths * self.depth


class GuideSpec(Frozen):
    """The settings of the guides, which are rendered beside each view's buffers."""

    light_samples: Annotated[int, Field(ge=0, le=64)] = 3  # shadow rays of each of a pixel's 16 sub-pixels; 0: none
    lights_in_glass: bool = Field(default=False, exclude_if=lambda said: not said)  # then left out of ids
    """Whether lights that smooth glass reflects, beside what it lets through, count as seen."""

    def without_shadows(self) -> Self:
        """The same without direct light: emission, and what says how much a surface reflects."""
        return self.model_copy(update={"light_samples": 0})


class Emitters(Frozen):
    """Factors on the radiance of the scene's own lights: those of its file or built-in room that no `Light` moves."""

    all: Factor = 1.0  # for every light: 0 switches it off
    by_id: dict[str, Factor] = Field(default_factory=dict)
    """The factors of single lights instead, by the id of their shape, or "environment"."""

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


INPUTS_GENERATOR = 2
"""The version of the code that makes buffers, guides, photons and points: it grows when their values change.

Stored specs are of version 2 and do not say so. Whoever raises it adds a field to the spec, 2 where it is absent.
"""

RAYS_PER_PIXEL = 16
"""The rays through a pixel over which albedo and guides are means."""

_INPUTS = ("photons", "guides", "points")


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
    stored_exponent: int | None = Field(default=None, exclude_if=lambda said: said is None)  # set when first stored

    @model_validator(mode="after")
    def _groups_are_distinct(self) -> Self:
        names = [group.name for group in self.groups]
        shapes = [shape for group in self.groups for shape in shape_ids(group)]
        for what, used in (("group name", names), ("shape id", shapes)):
            twice = sorted({name for name in used if used.count(name) > 1})
            if twice:
                raise ValueError(f"uses {what} {twice[0]!r} twice; each may belong to one movable group")
        return self

    @property
    def groups(self) -> tuple[Movable, ...]:
        """Every movable group, objects before lights: the order of the modification vector."""
        return self.objects + self.lights

    @property
    def further_changes(self) -> bool:
        """Whether any group turns, or changes what it emits: then configurations have `FURTHER` fields."""
        return any(group.turn for group in self.groups) or any(light.power or light.colour for light in self.lights)

    @property
    def pivots(self) -> Pivots | None:
        """What groups turn about; None in a scene whose configurations have no turns."""
        if not self.further_changes:
            return None
        return Pivots(np.array([group.at for group in self.groups]), np.array(self.view.up, np.float64))

    @cached_property
    def radiance_id(self) -> str:
        """32 hexadecimal digits: the digest of all that the mean of a sample and its size depend on.

        Keys and seeds follow from it.
        """
        return make_key("radiance", _canonical(self.radiance_settings())).hex()

    @cached_property
    def inputs_id(self) -> str:
        """32 hexadecimal digits: the digest of what buffers, guides, photons and points are made with."""
        return make_key("inputs", _canonical(self.inputs())).hex()

    @cached_property
    def scene_id(self) -> str:
        """32 hexadecimal digits, by which a store holds the scene: the digest of both other ids."""
        return make_key("scene", self.radiance_id, self.inputs_id).hex()

    def identity(self) -> dict[str, Any]:
        """All that ids are made of, as JSON has it: specs that agree in it are one scene."""
        return self.radiance_settings() | self.inputs()

    def radiance_settings(self) -> dict[str, Any]:
        """All that the mean of a sample and its size depend on."""
        not_of_it: dict[str, Any] = {"scene": {"file"}, "transport": STRATEGY | {"card"}}
        not_of_it |= dict.fromkeys(("name", "credits", "exposure", "stored_exponent", *_INPUTS), True)
        return self.model_dump(mode="json", exclude=not_of_it)

    def inputs(self) -> dict[str, Any]:
        """What buffers, guides, photons and points are made with."""
        made = {"generator": INPUTS_GENERATOR, "rays_per_pixel": RAYS_PER_PIXEL}
        return self.model_dump(mode="json", include=set(_INPUTS)) | made

    def strategy(self) -> dict[str, Any]:
        """How light is sampled: the settings of `STRATEGY`, which a job's marker records."""
        return self.transport.model_dump(mode="json", include=set(STRATEGY))

    @property
    def free_space_digest(self) -> str:
        """The digest of all that free space depends on: geometry, groups as they were modelled, boxes of views."""
        groups = [{"shapes": list(shape_ids(group)), "at": list(group.at)} for group in self.groups]
        scene = self.scene.model_dump(mode="json", exclude={"file"})
        view = self.view.model_dump(mode="json", include={"origin", "look_at", "near"})
        described = {"scene": scene, "content": self.content, "groups": groups, "view": view}
        return make_key("free space", _canonical(described)).hex()

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A changed copy; pydantic would keep the id of the original."""
        copied = super().model_copy(update=update, deep=deep)
        for name in ("radiance_id", "inputs_id", "scene_id"):
            copied.__dict__.pop(name, None)
        return copied

    @property
    def radiance_exponent(self) -> int:
        """The power of two that stored radiance is multiplied by, so that values exposed as at first lie near 1."""
        return int(np.round(np.log2(self.exposure))) if self.stored_exponent is None else self.stored_exponent


def _canonical(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ",".join(f"{k}:{_canonical(value[k])}" for k in sorted(value)) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(_canonical, value)) + "]"
    return repr(value)
