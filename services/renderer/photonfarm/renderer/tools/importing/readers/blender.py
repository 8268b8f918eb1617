"""Blender's .blend files, USD and FBX: Blender, in a process of its own, writes a GLB, which is read as any.

Blender is GPL and large, so it is no part of photonfarm. It is the program `blender`, or a Python that has its wheel
`bpy`: one of its own, as `bpy` needs an older numpy than the store.

Lamps and the sky go round the GLB, by the units of Cycles: watts, and watts per square metre for suns. The radiance of
an area A is P / (π·A), that of a sphere P / (4·π²·r²), and P / π for lamps that are not normalized; a point is the
limit r → 0. Objects scale areas and the cones of spots, not radii. All of it is measured on Cycles.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from photonfarm.core.errors import BackendError, SpecError
from photonfarm.core.waiting import Log
from photonfarm.renderer.tools.importing import elements, images
from photonfarm.renderer.tools.importing.elements import WIDEST, Profile, put_cones
from photonfarm.renderer.tools.importing.imported import Floats, ImportedScene, unit
from photonfarm.renderer.tools.importing.readers import gltf

VARIABLE = "PHOTONFARM_BLENDER"
"""The variable that names Blender, or a Python that has `bpy`."""

Lamp = dict[str, Any]
"""The numbers that Blender has of a lamp, its `strength` as a colour, and its `matrix` in its world."""

AXES = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""The map of Blender's coordinates, z up, to glTF's, y up."""

TURN, NOWHERE = np.array([-1.0, 1, -1]), np.zeros(3)
"""What turns the axes of a lamp, which shines along −z, to those of a light of Mitsuba's, which shines along +z."""

PARTS = 16
"""Spots with a radius, and areas of a small spread, become so many spots, which have no extent in Mitsuba."""

SHARP = math.radians(1.0)
"""A sun that is no wider is one direction; a wider one is a disc of the sky."""

_SCRIPT = Path(__file__).with_name("blender_export.py")


def read(path: Path, scratch: Path, log: Log) -> ImportedScene:
    """Read a file. Raises BackendError without Blender, SpecError if Blender cannot read the file."""
    command = blender_command(path)
    out = scratch / "exported.glb"
    log(f"{path.name}: Blender opens it")
    _run([*command, str(path.resolve()), str(out)], path, out)
    scene = ImportedScene()
    scene.changes.note("Blender's (x, y, z) is (x, z, −y) here")
    try:
        gltf.read(out, scratch, log, scene)
    except SpecError as error:
        raise SpecError(str(error).replace(str(out), str(path))) from error
    beside: dict[str, Any] = json.loads(out.with_suffix(".json").read_text(encoding="utf-8"))
    scene.objects = {made: beside["owners"].get(owner, owner) for made, owner in scene.objects.items()}
    for each in beside["said"]:
        scene.changes.say(*each)
    if beside["camera"] is not None:
        x, y, z = beside["camera"]
        scene.camera = (x, z, -y)
    lamps = Lamps(scene, scratch)
    for lamp in beside["lamps"]:
        lamps.put(lamp)
    lamps.put_sky(beside["sky"])
    return scene


def _run(command: list[str], path: Path, out: Path) -> None:
    made = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", check=False)
    if made.returncode == 0 and out.with_suffix(".json").is_file():
        return
    lines = [line.strip() for line in (made.stdout + made.stderr).splitlines() if line.strip()]
    faults = [line.removeprefix("fault: ")[:300] for line in lines if line.startswith("fault: ")]
    if faults:
        raise SpecError(f"{path}: {faults[0]}")
    said = ([line for line in lines if "rror" in line] or lines or ["it said nothing"])[-1][:300]
    raise SpecError(f"{path}: Blender cannot read it: {said}")


def blender_command(path: Path) -> list[str]:
    """The beginning of the command that exports a file; raises BackendError where there is no Blender."""
    named = os.environ.get(VARIABLE)
    program = shutil.which(named or "blender")
    if program is None and named:
        raise BackendError(f"{VARIABLE} = {named!r} is no program; name a Python that has bpy, or Blender itself")
    if program is None:
        raise BackendError(
            f"{path}: {path.suffix} files are read by Blender, which is not here: make it by `python3.11 -m venv bpy; "
            f"bpy/bin/pip install bpy; export {VARIABLE}=$PWD/bpy/bin/python` (370 MB), or export the scene as .glb"
        )
    if Path(program).name.startswith("python"):
        return [program, str(_SCRIPT)]
    return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python", str(_SCRIPT), "--"]


class Lamps:
    """Puts lamps into a scene; images go into the folder `scratch`."""

    def __init__(self, scene: ImportedScene, scratch: Path) -> None:
        self._scene, self._scratch = scene, scratch
        self._discs: list[tuple[Floats, Floats, float]] = []  # suns: direction, irradiance, sine of the half angle

    def put(self, lamp: Lamp) -> None:
        """Add a lamp: the numbers that Blender has of it, its `strength` as a colour, and its `matrix` in its world."""
        strength, matrix = np.array(lamp["strength"]), AXES @ np.array(lamp["matrix"])
        if strength.min() < 0:
            self._scene.changes.lose("light", "energy", "is negative, which no light is here", f"lamp {lamp['name']!r}")
        kinds = {"SUN": self._put_sun, "SPOT": self._put_spot, "POINT": self._put_point, "AREA": self._put_area}
        if strength.max() > 0:
            kinds[lamp["kind"]](lamp, np.maximum(strength, 0), matrix)

    def put_sky(self, sky: list[float] | str) -> None:
        """Surround the scene by a radiance, or by an image of all directions with Blender's +y in the middle; last."""
        sky = self._draw_discs(sky) if self._discs else sky
        if isinstance(sky, str):
            image = self._emitter("envmap", "sky")
            elements.put_value(image, "filename", sky)
            _place(image, np.diag([-1, 1, -1]))
        elif max(sky) > 0:
            elements.put_value(self._emitter("constant", "sky"), "radiance", sky)

    def _draw_discs(self, sky: list[float] | str) -> str:
        """An image of a sky with the discs of suns, each with its irradiance."""
        light = images.decode(Path(sky).read_bytes(), sky, raw=True)[..., :3] if isinstance(sky, str) else sky
        height, width = 1024, 2048
        values = np.broadcast_to(light, (height, width, 3)).astype(np.float64)
        down = (np.arange(height) + 0.5)[:, None] * math.pi / height
        along = (np.arange(width) + 0.5) * 2 * math.pi / width
        for (x, y, z), flux, sine in self._discs:
            cosine = y * np.cos(down) + np.sin(down) * (z * np.cos(along) - x * np.sin(along))
            disc = cosine >= math.sqrt(1 - sine**2)
            # Irradiance is the sum of radiance · cosine · solid angle, of a pixel sin(down)·2π²/(height·width)
            values[disc] += flux / (disc * cosine * np.sin(down)).sum() * height * width / (2 * math.pi**2)
        return str(images.save_radiance(values.astype(np.float32), self._scratch / "sky.exr"))

    def _put_sun(self, lamp: Lamp, strength: Floats, matrix: Floats) -> None:
        sine = math.sin(min(lamp["angle"], math.pi) / 2)
        flux = strength * (math.pi * sine**2 if sine and not lamp["normalize"] else 1.0)
        if lamp["angle"] > SHARP:
            self._discs.append((_frame(matrix)[:, 2], flux, sine))
            return
        sun = self._emitter("directional", lamp["name"])
        elements.put_value(sun, "irradiance", flux.tolist())
        _place(sun, _frame(matrix) * TURN)

    def _put_point(self, lamp: Lamp, strength: Floats, matrix: Floats) -> None:
        radius, intensity = float(lamp["shadow_soft_size"]), _intensity(lamp, strength)
        if radius == 0:
            point = self._emitter("point", lamp["name"])
            elements.put_value(point, "intensity", intensity.tolist())
            _place(point, np.eye(3), matrix[:3, 3])
        else:
            sphere = self._shape("sphere", lamp["name"], intensity / (math.pi * radius**2))
            _place(sphere, radius * np.eye(3), matrix[:3, 3])

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
        is_round, is_square = lamp["shape"] in ("DISK", "ELLIPSE"), lamp["shape"] in ("SQUARE", "DISK")
        sides = matrix[:3, :2] * (lamp["size"] / 2, lamp["size" if is_square else "size_y"] / 2)
        area = float(np.linalg.norm(np.cross(*sides.T))) * (math.pi if is_round else 4.0)
        if area == 0:
            return
        radiance = strength / (math.pi * (area if lamp["normalize"] else 1.0))
        half = max(lamp["spread"] / 2, math.radians(0.5))
        if half >= WIDEST:
            shape = self._shape("disk" if is_round else "rectangle", lamp["name"], radiance)
            sides[:, 0] *= -np.copysign(1, np.linalg.det(matrix[:3, :3]))  # the axes are right-handed then
            _place(shape, np.column_stack([sides, -_frame(matrix)[:, 2]]), matrix[:3, 3])
            return
        tangent = math.tan(half)

        def profile(x: Floats, y: Floats) -> Floats:
            return np.maximum(1 - np.hypot(x, y) / tangent, 0) / np.sqrt(1 + x * x + y * y)

        on_axis = radiance * area * tangent / (tangent - half)
        self._put_cones(lamp, on_axis, matrix, _spread_over(lamp["shape"]) @ sides.T, half, profile)

    def _put_cones(
        self, lamp: Lamp, intensity: Floats, matrix: Floats, places: Floats, cut: float, profile: Profile
    ) -> None:
        """Add spots at offsets (N, 3) that share an intensity; `profile`: its share at tangents (x, y) off the axis."""
        spots = [self._emitter("spot", lamp["name"]) for _ in places]
        for spot, place in zip(spots, places, strict=True):
            elements.put_value(spot, "intensity", (intensity / len(places)).tolist())
            _place(spot, _frame(matrix) * TURN, matrix[:3, 3] + place)
        put_cones(spots, profile, cut, self._scratch / f"{spots[0].get('id')}.png")
        if len(places) > 1:
            meaning = f"became {PARTS} spots, whose shadows are as soft, for its radius or its spread"
            self._scene.changes.note(meaning, f"lamp {lamp['name']!r}")

    def _emitter(self, kind: str, name: str) -> Element:
        return SubElement(self._scene.root, "emitter", type=kind, id=self._scene.ids.make(name, "lamp"))

    def _shape(self, kind: str, name: str, radiance: Floats) -> Element:
        """Add a black shape that emits."""
        made = SubElement(self._scene.root, "shape", type=kind, id=self._scene.ids.make(name, "lamp"))
        elements.put_value(SubElement(made, "bsdf", type="diffuse"), "reflectance", (0.0, 0.0, 0.0))
        elements.put_value(SubElement(made, "emitter", type="area"), "radiance", radiance.tolist())
        self._scene.objects[made.get("id", "")] = name
        self._scene.changes.note("cameras see it, which they do in Blender only if told to", f"lamp {name!r}")
        return made


def _intensity(lamp: Lamp, strength: Floats) -> Floats:
    """The radiant intensity: of a sphere π·r² times its radiance, and of a point P/(4π), or P/π if not normalized."""
    if lamp["normalize"]:
        return strength / (4 * math.pi)
    return strength * (lamp["shadow_soft_size"] ** 2 or 1 / math.pi)


def _frame(matrix: Floats) -> Floats:
    """The rotation (3, 3) of a matrix; its columns are the lamp's axes."""
    z = unit(matrix[:3, 2])
    y = unit(matrix[:3, 1] - z * (z @ matrix[:3, 1]))
    return np.stack([np.cross(y, z), y, z], axis=1)


def _place(light: Element, axes: Floats, place: Floats = NOWHERE) -> None:
    """Put a light at a place, with its axes as columns (3, 3)."""
    elements.put_matrix(light, "to_world", [*np.column_stack([axes, place]).tolist(), (0, 0, 0, 1)])


def _spread_over(shape: str) -> Floats:
    """Places (PARTS, 2) spread evenly over a shape within [−1, 1]²."""
    if shape in ("DISK", "ELLIPSE"):
        k = np.arange(PARTS) + 0.5
        radius, angle = np.sqrt(k / PARTS), k * math.pi * (3 - math.sqrt(5))
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    side = round(math.sqrt(PARTS))
    grid = (np.arange(side) + 0.5) * 2 / side - 1
    return np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
