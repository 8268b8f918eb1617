"""Blender's lamps and sky as Mitsuba's, by the units of Cycles: watts, and watts per square metre for suns.

The radiance of an area A is P / (π·A), that of a sphere P / (4·π²·r²), and P / π for lamps that are not normalized; a
point is the limit r → 0. Objects scale areas and the cones of spots, not radii. All of it is measured on Cycles.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing import elements
from photonfarm.renderer.importing.imported import Ids, ImportedScene
from photonfarm.renderer.importing.meshes import Mesh
from photonfarm.renderer.importing.readers import images

Floats = NDArray[np.float64]
Lamp = dict[str, Any]
Profile = Callable[[Floats, Floats], Floats]

AXES = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""The map of Blender's coordinates, z up, to glTF's, y up."""

PARTS = 16
"""Spots with a radius, and areas of a small spread, become so many spots, which have no extent in Mitsuba."""

SHARP = math.radians(1.0)
"""A sun that is no wider is one direction; a wider one is a disc of the sky."""

WIDEST, TEXELS, CORNERS = math.radians(89.5), 1024, 64

STEEP = math.radians(80)
"""Wider cones have finer images, as their tangents are large."""


class Lamps:
    """Puts lamps into a scene."""

    def __init__(self, scene: ImportedScene, scratch: Path) -> None:
        self._scene, self._scratch, self._ids, self._black = scene, scratch, Ids(), ""
        self._discs: list[tuple[Floats, Floats, float]] = []  # suns: direction, irradiance, sine of the half angle
        for part in scene.root.iter():
            self._ids.keep(part.get("id", ""))

    def put(self, lamp: Lamp) -> None:
        """Add a lamp: the numbers that Blender has of it, its `strength` as a colour, and its `matrix` in its world."""
        strength, matrix = np.array(lamp["strength"]), AXES @ np.array(lamp["matrix"])
        if strength.min() < 0:
            self._scene.changes.lose("light", "energy", "is negative, which no light is here", f"lamp {lamp['name']!r}")
        kinds = {"SUN": self._put_sun, "SPOT": self._put_spot, "POINT": self._put_point, "AREA": self._put_area}
        if strength.max() > 0 and lamp["kind"] in kinds:
            kinds[lamp["kind"]](lamp, np.maximum(strength, 0), matrix)

    def put_sky(self, sky: list[float] | str | None) -> None:
        """Surround the scene by a radiance, or by an image of all directions with Blender's +y in the middle; last."""
        if self._discs:
            sky = self._with_discs(sky)
        if sky is None:
            return
        emitter = self._emitter("envmap" if isinstance(sky, str) else "constant", "sky")
        if not isinstance(sky, str):
            elements.put_value(emitter, "radiance", sky)
            return
        elements.put_value(emitter, "filename", sky)
        elements.put_matrix(emitter, "to_world", np.diag([-1, 1, -1, 1]).tolist())

    def _with_discs(self, sky: list[float] | str | None) -> str:
        """An image of a sky with the discs of suns, each with its irradiance."""
        if isinstance(sky, str):
            values = images.decoded(Path(sky).read_bytes(), sky, raw=True)[..., :3].astype(np.float64)
        else:
            values = np.tile(np.array(sky or (0.0, 0.0, 0.0)), (1024, 2048, 1))
        down = (np.arange(len(values)) + 0.5)[:, None] * math.pi / len(values)
        along = (np.arange(values.shape[1]) + 0.5) * 2 * math.pi / values.shape[1]
        x, z = -np.sin(down) * np.sin(along), np.sin(down) * np.cos(along)
        for axis, flux, sine in self._discs:
            cosine = axis[0] * x + axis[1] * np.cos(down) + axis[2] * z
            disc = cosine >= math.sqrt(1 - sine**2)
            sizes = np.sin(down) * 2 * math.pi**2 / values[..., 0].size
            values[disc] += flux / (disc * cosine * sizes).sum()
        return str(images.save_radiance(values.astype(np.float32), self._scratch / "sky.exr"))

    def _put_sun(self, lamp: Lamp, strength: Floats, matrix: Floats) -> None:
        sine, axis = math.sin(min(lamp["angle"], math.pi) / 2), _frame(matrix)[:, 2]
        flux = strength * (math.pi * sine**2 if sine and not lamp["normalize"] else 1.0)
        if lamp["angle"] > SHARP:
            self._discs.append((axis, flux, sine))
            return
        sun = self._emitter("directional", lamp["name"])
        elements.put_value(sun, "irradiance", flux.tolist())
        elements.put_matrix(sun, "to_world", _towards(-axis, np.zeros(3)))

    def _put_point(self, lamp: Lamp, strength: Floats, matrix: Floats) -> None:
        radius = lamp["shadow_soft_size"]
        x, y, z = (f"{part:.9g}" for part in matrix[:3, 3])
        if radius == 0:
            point = self._emitter("point", lamp["name"])
            SubElement(point, "point", name="position", x=x, y=y, z=z)
            elements.put_value(point, "intensity", _intensity(lamp, strength).tolist())
            return
        made = self._ids.make(lamp["name"], "lamp")
        black = self._black_material()
        sphere = SubElement(self._scene.root, "shape", type="sphere", id=made)
        SubElement(sphere, "point", name="center", x=x, y=y, z=z)
        elements.put_value(sphere, "radius", float(radius))
        SubElement(sphere, "ref", id=black)
        sphere.append(elements.area_light((_intensity(lamp, strength) / (math.pi * radius**2)).tolist()))
        self._scene.objects[made] = lamp["name"]

    def _put_spot(self, lamp: Lamp, strength: Floats, matrix: Floats) -> None:
        """Add a spot: Cycles' cone is that of an object without scale, squeezed by its scale."""
        scale = np.linalg.norm(matrix[:3, :3], axis=0)
        half, blend = min(lamp["spot_size"] / 2, WIDEST), max(lamp["spot_blend"], 1e-4)
        cut = min(math.atan(math.tan(half) * max(scale[:2]) / scale[2]), WIDEST)

        def profile(x: Floats, y: Floats) -> Floats:
            cosine = 1 / np.sqrt(1 + (x * scale[2] / scale[0]) ** 2 + (y * scale[2] / scale[1]) ** 2)
            t = np.clip((cosine - math.cos(half)) / (blend * (1 - math.cos(half))), 0, 1)
            return t * t * (3 - 2 * t)

        places = lamp["shadow_soft_size"] * (_spread_over("DISK") if lamp["shadow_soft_size"] else np.zeros((1, 2)))
        self._put_cones(lamp, _intensity(lamp, strength), matrix, places @ _frame(matrix)[:, :2].T, cut, profile)

    def _put_area(self, lamp: Lamp, strength: Floats, matrix: Floats) -> None:
        """Add an area that shines along −z; one whose light is spread less than by a cosine becomes cones."""
        round_one, square = lamp["shape"] in ("DISK", "ELLIPSE"), lamp["shape"] in ("SQUARE", "DISK")
        size = np.array([lamp["size"], lamp["size"] if square else lamp["size_y"]]) / 2
        n, turn = (CORNERS, 0.0) if round_one else (4, math.pi / 4)
        angles = turn - 2 * np.pi * np.arange(n) / n  # clockwise from above, as it faces down
        stretch = math.sqrt(2 * math.pi / (n * math.sin(2 * math.pi / n))) if round_one else math.sqrt(2)
        corners = np.stack([np.cos(angles) * size[0], np.sin(angles) * size[1], 0 * angles], axis=1)
        fan = np.array([(0, k, k + 1) for k in range(1, n - 1)], np.uint32)
        mesh = Mesh(corners * stretch, fan).moved(matrix)
        area = float(np.linalg.norm(np.cross(matrix[:3, 0], matrix[:3, 1])) * size[0] * size[1])
        area *= math.pi if round_one else 4.0
        if area == 0:
            return
        radiance = strength / (math.pi * (area if lamp["normalize"] else 1.0))
        half = lamp["spread"] / 2
        if half >= WIDEST:
            made = self._ids.make(lamp["name"], "lamp")
            light = elements.area_light(radiance.tolist())
            self._scene.put_shape(made, mesh, self._black_material(), lamp["name"], light)
            return
        tangent = math.tan(half := max(half, math.radians(0.5)))

        def profile(x: Floats, y: Floats) -> Floats:
            return np.maximum(1 - np.hypot(x, y) / tangent, 0) / np.sqrt(1 + x * x + y * y)

        places = _spread_over(lamp["shape"]) * size @ matrix[:3, :2].T
        on_axis = radiance * area * tangent / (tangent - half)
        self._put_cones(lamp, on_axis, matrix, places, half, profile)

    def _put_cones(
        self, lamp: Lamp, intensity: Floats, matrix: Floats, places: Floats, cut: float, profile: Profile
    ) -> None:
        """Add spots at offsets (N, 3) that share an intensity; `profile`: its share at tangents (x, y) off the axis."""
        made = self._ids.make(lamp["name"], "lamp")
        file = cone_image(profile, cut, self._scratch / f"{made}.png")
        axis, up = -_frame(matrix)[:, 2], _frame(matrix)[:, 1]
        for place in places:
            spot = self._emitter("spot", lamp["name"])
            elements.put_value(spot, "intensity", (intensity / len(places)).tolist())
            elements.put_matrix(spot, "to_world", _towards(axis, matrix[:3, 3] + place, up))
            put_cone(spot, cut, file)
        if len(places) > 1:
            meaning = (
                f"spots with a radius and areas with a spread become {PARTS} spots each, whose shadows are as soft"
            )
            self._scene.changes.note(meaning, f"lamp {lamp['name']!r}")

    def _emitter(self, kind: str, name: str) -> Element:
        return SubElement(self._scene.root, "emitter", type=kind, id=self._ids.make(name, "lamp"))

    def _black_material(self) -> str:
        if not self._black:
            self._black = self._ids.make("black")
            made = Element("bsdf", type="diffuse", id=self._black)
            elements.put_value(made, "reflectance", (0.0, 0.0, 0.0))
            self._scene.root.insert(0, made)
        return self._black


def cone_image(profile: Profile, cut: float, file: Path) -> Path:
    """The image of a spot within an angle; `profile`: its share at tangents (x, y) off the axis."""
    texels = TEXELS if cut < STEEP else 2 * TEXELS
    y, x = np.meshgrid(*[math.tan(cut) * (2 * (np.arange(texels) + 0.5) / texels - 1)] * 2, indexing="ij")
    return images.save(profile(x, y).astype(np.float32), file)


def put_cone(spot: Element, cut: float, file: Path) -> None:
    """Let a spot end at an angle and fade as an image says."""
    elements.put_value(spot, "cutoff_angle", math.degrees(cut))
    elements.put_value(spot, "beam_width", math.degrees(cut) * 0.999)
    elements.put_value(elements.put_bitmap(spot, "texture", file, raw=True), "wrap_mode", "clamp")


def _intensity(lamp: Lamp, strength: Floats) -> Floats:
    """The radiant intensity of a point, and of a sphere of the lamp's radius."""
    if lamp["normalize"]:
        return strength / (4 * math.pi)
    return strength * (lamp["shadow_soft_size"] ** 2 or 1 / math.pi)


def _frame(matrix: Floats) -> Floats:
    """The rotation (3, 3) of a matrix; its columns are the lamp's axes."""
    z = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    y = matrix[:3, 1] - z * (z @ matrix[:3, 1])
    y = y / np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)


def _towards(axis: Floats, place: Floats, up: Floats | None = None) -> list[list[float]]:
    """The matrix of a light at a place that shines along an axis, which is Mitsuba's +z."""
    if up is None:
        up = np.eye(3)[int(np.argmin(np.abs(axis)))]
    matrix = np.eye(4)
    matrix[:3, :3] = _frame(np.stack([axis, up, axis], axis=1))
    matrix[:3, 3] = place
    rows: list[list[float]] = matrix.tolist()
    return rows


def _spread_over(shape: str) -> Floats:
    """Places (PARTS, 2) spread evenly over a shape within [−1, 1]²."""
    k = np.arange(PARTS) + 0.5
    if shape in ("DISK", "ELLIPSE"):
        radius, angle = np.sqrt(k / PARTS), k * math.pi * (3 - math.sqrt(5))
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    side = round(math.sqrt(PARTS))
    grid = (np.arange(side) + 0.5) * 2 / side - 1
    return np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
