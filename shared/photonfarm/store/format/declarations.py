"""What the format declares: its version, and every array with type, shape, unit and convention. Part of the version.

docs/store-format.md repeats it for readers; a test compares the two, and every array carries it in its attributes.

Shape letters: R rows of a plan, H W image, K photon slots, L lit points, G movable groups; of the base: P points,
V vertices, F triangles, S shapes.
"""

from __future__ import annotations

import re
import secrets
from dataclasses import dataclass
from typing import Any

import numpy as np

from photonfarm.core.errors import StoreError
from photonfarm.core.keys import KEY_BYTES

FORMAT = "photonfarm store"
VERSION = 5

PARTS = 2
"""The independent parts of a sample: the halves A and B."""


def stamp() -> dict[str, Any]:
    """The format and its version, as the store and every Zarr group in it state them."""
    return {"format": FORMAT, "version": VERSION}


def new_store_id() -> str:
    """An id for a new store: random, as two stores may hold the same scenes."""
    return secrets.token_hex(16)


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
    shape: tuple[str | int, ...]  # their lengths: numbers, or shape letters; "⌈P/8⌉" is P/8 rounded up
    dtype: str  # numpy's notation; always little-endian
    unit: str
    convention: str
    compressed: bool = True

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes of the stored array."""
        return {"unit": self.unit, "convention": self.convention}

    @property
    def fill(self) -> float | int:
        """The value read where nothing is written: NaN, −1, or 0 for unsigned types."""
        return {"f": np.nan, "i": -1, "u": 0}[np.dtype(self.dtype).kind]


_RADIANCE = "radiance, as the scene states its emitters"
_FLUX = "flux: radiance × scene unit² × sr"
_HALVES = "linear RGB, mean over the pixel, not clipped; halves A and B are independent estimates"
_WORLD = "world coordinates"
_BITS = "bit i of byte j, bit 0 the least significant"
_SEEN = "1: in the image, and hidden by nothing; bits left over: 0"

_SAMPLES_AND_BUFFERS = (
    ArrayDeclaration(
        "radiance",
        ("sample", "half", "y", "x", "channel"),
        ("R", 2, "H", "W", 3),
        "<f2",
        _RADIANCE,
        f"{_HALVES}; stored × 2^radiance_exponent; all NaN in a row that float16 cannot hold: see radiance_wide",
        compressed=False,
    ),
    ArrayDeclaration(
        "radiance_wide",
        ("sample", "half", "y", "x", "channel"),
        ("R", 2, "H", "W", 3),
        "<f4",
        _RADIANCE,
        f"{_HALVES}; rows that float16 cannot hold, stored × 2^radiance_exponent with the exponent 0",
        compressed=False,
    ),
    ArrayDeclaration(
        "depth",
        ("view", "y", "x"),
        ("R", "H", "W"),
        "<f4",
        "scene units",
        "along the camera's forward axis, not along the ray; 0: nothing is met between the near and the far plane",
    ),
    ArrayDeclaration(
        "albedo",
        ("view", "y", "x", "channel"),
        ("R", "H", "W", 3),
        "<f2",
        "1",
        "diffuse reflectance, linear RGB, mean over the pixel; 0: nothing is met, or it has no diffuse part",
    ),
    ArrayDeclaration(
        "normal",
        ("view", "y", "x", "axis"),
        ("R", "H", "W", 3),
        "<f2",
        "1",
        f"unit shading normal, {_WORLD}, as modelled: not turned to the camera; 0: nothing is met",
    ),
    ArrayDeclaration(
        "point_seen",
        ("view", "byte"),
        ("R", "⌈P/8⌉"),
        "|u1",
        "1",
        f"{_BITS}: whether the view sees point 8j + i of the cloud; {_SEEN}",
    ),
    ArrayDeclaration(
        "photon_seen",
        ("view", "byte"),
        ("R", "⌈K/8⌉"),
        "|u1",
        "1",
        f"{_BITS}: whether the view sees the photon in slot 8j + i of its modification; {_SEEN}",
    ),
    ArrayDeclaration(
        "photon_position",
        ("modification", "slot", "axis"),
        ("R", "K", 3),
        "<f4",
        "scene units",
        f"where the light arrives, {_WORLD}",
    ),
    ArrayDeclaration(
        "photon_direction",
        ("modification", "slot", "axis"),
        ("R", "K", 3),
        "<f2",
        "1",
        f"unit, the way the light travels on arriving, {_WORLD}",
    ),
    ArrayDeclaration(
        "photon_normal",
        ("modification", "slot", "axis"),
        ("R", "K", 3),
        "<f2",
        "1",
        f"unit geometric normal, {_WORLD}, as modelled: not turned to the light",
    ),
    ArrayDeclaration(
        "photon_power",
        ("modification", "slot", "channel"),
        ("R", "K", 3),
        "<f4",
        _FLUX,
        "linear RGB that arrives, before reflection, over the number of paths: sums do not depend on that number",
    ),
    ArrayDeclaration(
        "photon_bounce",
        ("modification", "slot"),
        ("R", "K"),
        "|i1",
        "1",
        "surfaces met before: 0 straight from a light; -1: an empty slot, 0 in the other arrays",
    ),
)
_MEAN = "mean over the pixel"
_FIRST = "of the first surface"
_BEYOND = "of the surface that pure mirrors, glass and null surfaces lead to; 0: the first surface is none of these"

GUIDES = (
    ArrayDeclaration(
        "emission",
        ("view", "y", "x", "channel"),
        ("R", "H", "W", 3),
        "<f4",
        _RADIANCE,
        f"linear RGB emitted towards the eye, {_MEAN}, also by what mirrors and glass lead to; free of noise",
    ),
    ArrayDeclaration(
        "direct",
        ("view", "y", "x", "channel"),
        ("R", "H", "W", 3),
        "<f4",
        _RADIANCE,
        f"linear RGB, {_MEAN}: diffuse reflection of light that arrives straight from lights, also at what mirrors and "
        "glass lead to; noisy, by a seed of its own; rounded to 8 significant bits",
    ),
    ArrayDeclaration(
        "gloss",
        ("view", "y", "x", "channel"),
        ("R", "H", "W", 3),
        "<f4",
        _RADIANCE,
        f"as direct, reflected by all other lobes, {_MEAN}; may be below 0, as both together are the whole",
    ),
    ArrayDeclaration(
        "specular",
        ("view", "y", "x", "channel"),
        ("R", "H", "W", 3),
        "<f2",
        "1",
        f"directional albedo of all lobes {_FIRST} but the diffuse one, at least 0, {_MEAN}",
    ),
    ArrayDeclaration(
        "roughness",
        ("view", "y", "x"),
        ("R", "H", "W"),
        "<f2",
        "1",
        f"microfacet alpha {_FIRST}, {_MEAN}; 0: mirror, glass, or nothing is met; 1: diffuse",
    ),
    ArrayDeclaration(
        "mean_depth",
        ("view", "y", "x"),
        ("R", "H", "W"),
        "<f4",
        "scene units",
        f"along the camera's forward axis, {_FIRST}, {_MEAN} of the rays that meet one",
    ),
    ArrayDeclaration(
        "mean_normal",
        ("view", "y", "x", "axis"),
        ("R", "H", "W", 3),
        "<f2",
        "1",
        f"shading normal {_FIRST} turned to the eye, {_WORLD}, {_MEAN}; not of unit length",
    ),
    ArrayDeclaration(
        "throughput",
        ("view", "y", "x", "channel"),
        ("R", "H", "W", 3),
        "<f2",
        "1",
        "what pure mirrors, glass and null surfaces let through on the way to the surface they lead to, "
        f"{_MEAN}; 0: the first surface is none of these",
    ),
    ArrayDeclaration(
        "beyond_albedo",
        ("view", "y", "x", "channel"),
        ("R", "H", "W", 3),
        "<f2",
        "1",
        f"diffuse reflectance, {_MEAN}, {_BEYOND}",
    ),
    ArrayDeclaration(
        "beyond_normal",
        ("view", "y", "x", "axis"),
        ("R", "H", "W", 3),
        "<f2",
        "1",
        f"shading normal turned to where the path comes from, {_WORLD}, {_MEAN}, {_BEYOND}",
    ),
    ArrayDeclaration(
        "beyond_depth",
        ("view", "y", "x"),
        ("R", "H", "W"),
        "<f4",
        "scene units",
        f"length of the path from the eye, {_MEAN}, {_BEYOND}",
    ),
    ArrayDeclaration(
        "point_light",
        ("view", "point", "channel"),
        ("R", "L", 3),
        "<f4",
        "radiance × sr",
        "irradiance, linear RGB, of the cloud's first L points as the view's modification has them, on the side of the "
        "normal, by light that arrives straight from lights; noisy and rounded as direct",
    ),
)
"""The guides of a view, which jobs produce with its buffers."""

OUTPUTS = (*_SAMPLES_AND_BUFFERS, *GUIDES)
"""The arrays that jobs produce. The first axis names what a row belongs to."""

_OVER = "over that of uniform draws from the spec: 1 of such a draw"

PLAN_INPUTS = (
    ArrayDeclaration(
        "modification",
        ("modification", "group", "component"),
        ("R", "G", 4),
        "<f4",
        "see fields",
        "what may change of each movable group, by the attributes groups and fields; NaN: unused row",
    ),
    ArrayDeclaration(
        "view",
        ("view", "component"),
        ("R", 6),
        "<f4",
        "see fields",
        f"a camera in {_WORLD}, by the attribute fields; NaN: unused row",
    ),
    ArrayDeclaration(
        "sample_modification",
        ("sample",),
        ("R",),
        "<i8",
        "row of the scene",
        "the sample's modification; -1: unused row",
    ),
    ArrayDeclaration(
        "sample_view", ("sample",), ("R",), "<i8", "row of the scene", "the sample's view; -1: unused row"
    ),
    ArrayDeclaration(
        "sample_pass", ("sample",), ("R",), "<i4", "1", "number of the noisy pass, from 0; -1: unused row"
    ),
    ArrayDeclaration(
        "sample_key", ("sample", "byte"), ("R", KEY_BYTES), "|u1", "1", "the sample's content key; zeros: unused row"
    ),
    ArrayDeclaration(
        "modification_density",
        ("modification",),
        ("R",),
        "<f4",
        "1",
        f"the density by which the configuration was chosen, {_OVER}; NaN: a person chose it, or an unused row",
    ),
    ArrayDeclaration(
        "view_density",
        ("view",),
        ("R",),
        "<f4",
        "1",
        f"the density by which the view was chosen, given its configuration, {_OVER}; NaN as above",
    ),
)
"""The arrays of a plan's inputs."""

BASE = {
    "geometry": (
        ArrayDeclaration("vertices", ("vertex", "axis"), ("V", 3), "<f4", "scene units", f"{_WORLD}, at rest"),
        ArrayDeclaration(
            "faces", ("triangle", "corner"), ("F", 3), "<u4", "row of vertices", "corners of each triangle"
        ),
        ArrayDeclaration("face_shape", ("triangle",), ("F",), "<i4", "index of a shape", "ascending: shape by shape"),
        ArrayDeclaration(
            "shape_group",
            ("shape",),
            ("S",),
            "<i2",
            "index of a movable group",
            "the one it is of; -1: never moves",
        ),
    ),
    "cloud": (
        ArrayDeclaration("position", ("point", "axis"), ("P", 3), "<f4", "scene units", f"{_WORLD}, at rest"),
        ArrayDeclaration(
            "normal", ("point", "axis"), ("P", 3), "<f4", "1", f"unit geometric normal, {_WORLD}, as modelled"
        ),
        ArrayDeclaration("albedo", ("point", "channel"), ("P", 3), "<f4", "1", "diffuse reflectance, linear RGB"),
        ArrayDeclaration(
            "emission", ("point", "channel"), ("P", 3), "<f4", _RADIANCE, "linear RGB leaving along the normal"
        ),
        ArrayDeclaration(
            "group", ("point",), ("P",), "<i2", "index of a movable group", "the one it moves with; -1: never moves"
        ),
        ArrayDeclaration("face", ("point",), ("P",), "<u4", "row of faces", "the triangle that the point lies in"),
    ),
}
"""The arrays that are stored once per scene, by group."""
