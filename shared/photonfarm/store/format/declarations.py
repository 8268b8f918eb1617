"""What the format declares: its version, and every array with type, shape, unit and convention. Part of the version.

docs/store-format.md repeats it for readers; a test compares the two, and every array carries it in its attributes.

Shape letters: R rows of a plan, H W image, K photon slots, L lit points, G movable groups; of the base: P points,
V vertices, F triangles, S shapes; ⌈P/8⌉ is P/8 rounded up; C fields of a modification, D of a view.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from photonfarm.core.errors import StoreError

FORMAT = "photonfarm store"
VERSION = 5

PARTS = 2
"""The independent parts of a sample: the halves A and B."""


def stamp() -> dict[str, Any]:
    """The format and its version, as the store and every Zarr group in it state them."""
    return {"format": FORMAT, "version": VERSION}


def new_document() -> dict[str, Any]:
    """The document of a store made now. Its id is random, as two stores may hold the same scenes."""
    return {**stamp(), "id": secrets.token_hex(16)}


def is_store_id(value: object) -> bool:
    """Whether a value has the form of a store's id."""
    return isinstance(value, str) and re.fullmatch("[0-9a-f]{32}", value) is not None


def check_version(name: object, version: object, where: str, document: str = "photonfarm.json") -> None:
    """Return for the format that this program reads and writes; raises StoreError, with a remedy, for any other.

    `document` is the name of the file that states them.
    """
    if name == FORMAT and type(version) is int and version == VERSION:
        return
    if name != FORMAT:
        advice = f"Give the folder of a photonfarm store, or restore {document} from a copy."
    elif type(version) is not int or version < 1:
        advice = f"No photonfarm has written that: versions count from 1. Restore {document} from a copy."
    elif version < VERSION:
        advice = (
            "An older photonfarm made it: `photonfarm submit` renders its samples into a new store, and this one stays "
            "as it is."
        )
    else:
        advice = "A newer photonfarm made it: install that one. Nothing in it has been changed."
    raise StoreError(
        f"{where}: has format {name!r} version {version!r}; this program reads and writes {FORMAT!r} version "
        f"{VERSION}. {advice}"
    )


@dataclass(frozen=True, slots=True)
class ArrayDeclaration:
    """One array as the format declares it, for scenes of any size."""

    name: str
    axes: tuple[str, ...]  # names of the axes
    shape: tuple[str | int, ...]  # their lengths: numbers, or shape letters
    dtype: str  # numpy's notation; always little-endian
    unit: str
    convention: str

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes of the stored array."""
        return {"unit": self.unit, "convention": self.convention}

    @property
    def fill(self) -> float | int:
        """The value read where nothing is written: NaN, −1, or 0 for unsigned types."""
        return {"f": np.nan, "i": -1, "u": 0}[np.dtype(self.dtype).kind]

    @property
    def compressed(self) -> bool:
        """Whether it is stored compressed: all but noise."""
        return self.name not in ("radiance", "radiance_wide")


def _declare(table: str) -> tuple[ArrayDeclaration, ...]:
    """The arrays of a table: a line `name: axis length, …; type; unit` for each, then its convention, indented."""
    declared = []
    for entry in re.split(r"\n(?=\S)", table.strip()):
        head, *convention = entry.split("\n")
        name, described = head.split(": ", 1)
        axes, dtype, unit = described.split("; ")
        pairs = [axis.split() for axis in axes.split(", ")]
        shape = tuple(int(length) if length.isdecimal() else length for _, length in pairs)
        said = " ".join(map(str.strip, convention))
        declared.append(ArrayDeclaration(name, tuple(axis for axis, _ in pairs), shape, dtype, unit, said))
    return tuple(declared)


_RADIANCE = "radiance, as the scene states its emitters"
_HALVES = "linear RGB, mean over the pixel, not clipped; halves A and B are independent estimates"
_WORLD = "world coordinates"
_SEEN = "1: in the image, and hidden by nothing; bits left over: 0"
_MEAN = "mean over the pixel"
_FIRST = "of the first surface"
_BEYOND = "of the surface that pure mirrors, glass and null surfaces lead to; 0: the first surface is none of these"
_OVER = "over that of uniform draws from the spec: 1 of such a draw"

GUIDES = _declare(f"""
emission: view R, y H, x W, channel 3; <f4; {_RADIANCE}
    linear RGB emitted towards the eye, {_MEAN}, also by what mirrors and glass lead to; free of noise
direct: view R, y H, x W, channel 3; <f4; {_RADIANCE}
    linear RGB, {_MEAN}: diffuse reflection of light that arrives straight from lights, also at what mirrors and
    glass lead to; noisy, by a seed of its own; rounded to 8 significant bits
gloss: view R, y H, x W, channel 3; <f4; {_RADIANCE}
    as direct, reflected by all other lobes, {_MEAN}; may be below 0, as both together are the whole
specular: view R, y H, x W, channel 3; <f2; 1
    directional albedo of all lobes {_FIRST} but the diffuse one, at least 0, {_MEAN}
roughness: view R, y H, x W; <f2; 1
    microfacet alpha {_FIRST}, {_MEAN}; 0: mirror, glass, or nothing is met; 1: diffuse
mean_depth: view R, y H, x W; <f4; scene units
    along the camera's forward axis, {_FIRST}, {_MEAN} of the rays that meet one
mean_normal: view R, y H, x W, axis 3; <f2; 1
    shading normal {_FIRST} turned to the eye, {_WORLD}, {_MEAN}; not of unit length
throughput: view R, y H, x W, channel 3; <f2; 1
    what pure mirrors, glass and null surfaces let through on the way to the surface they lead to,
    {_MEAN}; 0: the first surface is none of these
beyond_albedo: view R, y H, x W, channel 3; <f2; 1
    diffuse reflectance, {_MEAN}, {_BEYOND}
beyond_normal: view R, y H, x W, axis 3; <f2; 1
    shading normal turned to where the path comes from, {_WORLD}, {_MEAN}, {_BEYOND}
beyond_depth: view R, y H, x W; <f4; scene units
    length of the path from the eye, {_MEAN}, {_BEYOND}
point_light: view R, point L, channel 3; <f4; radiance × sr
    irradiance, linear RGB, of the cloud's first L points as the view's modification has them, on the side of the
    normal, by light that arrives straight from lights; noisy and rounded as direct
""")
"""The guides of a view, which jobs produce with its buffers."""

OUTPUTS = (
    *_declare(f"""
radiance: sample R, half 2, y H, x W, channel 3; <f2; {_RADIANCE}
    {_HALVES}; stored × 2^radiance_exponent; all NaN in a row that float16 cannot hold: see radiance_wide
radiance_wide: sample R, half 2, y H, x W, channel 3; <f4; {_RADIANCE}
    {_HALVES}; rows that float16 cannot hold, stored × 2^radiance_exponent with the exponent 0
depth: view R, y H, x W; <f4; scene units
    along the camera's forward axis, not along the ray; 0: nothing is met between the near and the far plane
albedo: view R, y H, x W, channel 3; <f2; 1
    diffuse reflectance, linear RGB, {_MEAN}; 0: nothing is met, or it has no diffuse part
normal: view R, y H, x W, axis 3; <f2; 1
    unit shading normal, {_WORLD}, as modelled: not turned to the camera; 0: nothing is met
point_seen: view R, byte ⌈P/8⌉; |u1; 1
    bit i of byte j, bit 0 the least significant: whether the view sees point 8j + i of the cloud; {_SEEN}
photon_seen: view R, byte ⌈K/8⌉; |u1; 1
    bit i of byte j, bit 0 the least significant: whether the view sees the photon in slot 8j + i of its modification;
    {_SEEN}
photon_position: modification R, slot K, axis 3; <f4; scene units
    where the light arrives, {_WORLD}
photon_direction: modification R, slot K, axis 3; <f2; 1
    unit, the way the light travels on arriving, {_WORLD}
photon_normal: modification R, slot K, axis 3; <f2; 1
    unit geometric normal, {_WORLD}, as modelled: not turned to the light
photon_power: modification R, slot K, channel 3; <f4; flux: radiance × scene unit² × sr
    linear RGB that arrives, before reflection, over the number of paths: sums do not depend on that number
photon_bounce: modification R, slot K; |i1; 1
    surfaces met before: 0 straight from a light; -1: an empty slot, 0 in the other arrays
"""),
    *GUIDES,
)
"""The arrays that jobs produce. The first axis names what a row belongs to."""

PLAN_INPUTS = _declare(f"""
modification: modification R, group G, component C; <f4; see fields
    what may change of each movable group, by the attributes groups and fields; NaN: unused row
view: view R, component D; <f4; see fields
    a camera in {_WORLD}, by the attribute fields; NaN: unused row
sample_modification: sample R; <i8; row of the scene
    the sample's modification; -1: unused row
sample_view: sample R; <i8; row of the scene
    the sample's view; -1: unused row
sample_pass: sample R; <i4; 1
    number of the noisy pass, from 0; -1: unused row
sample_key: sample R, byte 16; |u1; 1
    the sample's content key; zeros: unused row
modification_density: modification R; <f4; 1
    the density by which the configuration was chosen, {_OVER}; NaN: a person chose it, or an unused row
view_density: view R; <f4; 1
    the density by which the view was chosen, given its configuration, {_OVER}; NaN as above
""")
"""The arrays of a plan's inputs."""

BASE = {
    "geometry": _declare(f"""
vertices: vertex V, axis 3; <f4; scene units
    {_WORLD}, at rest
faces: triangle F, corner 3; <u4; row of vertices
    corners of each triangle
face_shape: triangle F; <i4; index of a shape
    ascending: shape by shape
shape_group: shape S; <i2; index of a movable group
    the one it is of; -1: never moves
"""),
    "cloud": _declare(f"""
position: point P, axis 3; <f4; scene units
    {_WORLD}, at rest
normal: point P, axis 3; <f4; 1
    unit geometric normal, {_WORLD}, as modelled
albedo: point P, channel 3; <f4; 1
    diffuse reflectance, linear RGB
emission: point P, channel 3; <f4; {_RADIANCE}
    linear RGB leaving along the normal
group: point P; <i2; index of a movable group
    the one it moves with; -1: never moves
face: point P; <u4; row of faces
    the triangle that the point lies in
"""),
}
"""The arrays that are stored once per scene, by group."""

FIELDS: dict[str, tuple[dict[str, Any], ...]] = {
    "modification": (
        *(
            {"name": axis, "unit": "scene units", "rest": 0.0, "zero": "where the group was modelled"}
            for axis in ("x", "y", "z")
        ),
        {"name": "present", "unit": "1", "rest": 1.0, "zero": "removed"},
    ),
    "view": tuple(
        {"name": f"{point}_{axis}", "unit": "scene units", "rest": 0.0, "zero": "the origin of world coordinates"}
        for point in ("origin", "look_at")
        for axis in "xyz"
    ),
}
"""What the columns of `modification`, for each group, and of `view` hold, in order; part of the format's version.

A field that a plan lacks is at `rest` in all of its rows; `zero` says what 0 means.
"""


FURTHER: dict[str, tuple[dict[str, Any], ...]] = {
    "modification": (
        {"name": "turn", "unit": "degrees", "rest": 0.0, "zero": "as the group was modelled"},
        {"name": "power", "unit": "1", "rest": 1.0, "zero": "its lights are dark"},
        *({"name": colour, "unit": "1", "rest": 1.0, "zero": "none is emitted"} for colour in ("red", "green", "blue")),
    ),
    "view": ({"name": "fov", "unit": "degrees", "rest": 0.0, "zero": "view.fov_deg of the spec"},),
}
"""What further columns hold, all of which a scene's vectors have if any of its groups, or its cameras, change so."""


def vector_attributes(name: str, groups: Sequence[str], columns: int) -> dict[str, Any]:
    """The attributes that describe the columns of an array of inputs, of which there are so many.

    They are empty for an array that holds no vectors.
    """
    fields = [*FIELDS[name], *FURTHER[name]][:columns] if name in FIELDS else []
    described: dict[str, Any] = {"fields": fields} if fields else {}
    return described | ({"groups": list(groups)} if name == "modification" else {})
