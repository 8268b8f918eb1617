"""Imported scenes beside what Blender and Cycles make of the same files: surfaces, colours, and light."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from math import pi, radians
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.tools.importing import elements
from photonfarm.renderer.tools.importing.imported import ImportedScene
from photonfarm.renderer.tools.importing.loading import load
from photonfarm.renderer.tools.importing.readers import reader_of
from photonfarm.renderer.tools.importing.readers.blender import VARIABLE

SCRIPT = Path(__file__).with_name("blender_render.py")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"{VARIABLE} names no Blender"),
]


@dataclass(frozen=True, slots=True)
class Row:
    """What an import and Blender have of one file."""

    file: str
    reader: str
    triangles: tuple[int, int]  # ours, without sheets behind lights; Blender's
    area: tuple[float, float]
    box: float  # the largest difference of the bounds, as a share of their diagonal
    albedo: float  # the 90th percentile of differences of diffuse reflectance, over pixels
    radiance: tuple[float, ...]  # of each picture, the mean of ours over that of Cycles; NaN where both are dark

    def __str__(self) -> str:
        light = " ".join("dark" if np.isnan(ratio) else f"{ratio:.3f}" for ratio in self.radiance)
        triangles, area = "/".join(map(str, self.triangles)), "/".join(f"{part:.5g}" for part in self.area)
        return f"{self.file:40} {self.reader:8} {triangles:>13} {area:>15} {self.box:8.1e} {self.albedo:7.3f}  {light}"


def run_in_blender(jobs: list[dict[str, Any]], folder: Path) -> list[Any]:
    """What Blender makes of jobs of `blender_render.py`."""
    (folder / "jobs.json").write_text(json.dumps(jobs))
    command = [os.environ[VARIABLE]]
    if not Path(command[0]).name.startswith("python"):
        command += ["--background", "--factory-startup", "--python"]
    command += [str(SCRIPT), "--", str(folder / "jobs.json"), str(folder / "results.json")]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr[-2000:]
    results: list[Any] = json.loads((folder / "results.json").read_text())
    return results


def imported(file: Path, scratch: Path, *, sky: bool = False) -> tuple[ImportedScene, Any]:
    """What its reader makes of a file, and that as a Mitsuba scene, below a white sky or not."""
    scratch.mkdir(parents=True, exist_ok=True)
    scene = reader_of(file)(file, scratch, lambda _: None)
    if sky:
        elements.put_sky(scene.root)
    return scene, load(scene, scratch, lambda _: None)


def picture(scene: Any, view: list[list[float]], size: int = 24) -> np.ndarray:
    """Radiance, diffuse reflectance and whether no light is seen (size, size, 7), as `blender_render.py` looks."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": size, "height": size, "filter": {"type": "box"}, "pixel_format": "rgb"}
    to_world = mi.ScalarTransform4f().look_at(*view, [0, 1, 0])
    camera = {"type": "perspective", "fov": 60.0, "near_clip": 1e-3, "to_world": to_world, "film": film}
    sensor = mi.load_dict({**camera, "sampler": {"type": "independent", "sample_count": 256}})
    integrator = mi.load_dict({"type": "aov", "aovs": "a:albedo", "image": {"type": "path", "max_depth": 33}})
    values = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=256))
    lamps = np.array(mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": "path", "max_depth": 1}), spp=64))
    return np.concatenate([values[..., :6], lamps[..., :3].sum(axis=2, keepdims=True) == 0], axis=2)


def cycles_picture(file: str) -> np.ndarray:
    """Radiance and diffuse reflectance (size, size, 6) that Cycles wrote."""
    import mitsuba as mi

    from photonfarm.renderer.scene.loading import threads_to_read_with

    with threads_to_read_with():
        bitmap = mi.Bitmap(file)
    names = [field.name for field in bitmap.struct_()]
    wanted = [f"{layer}.{part}" for layer in ("Combined", "Diffuse Color") for part in "RGB"]
    numbers = [next(k for k, name in enumerate(names) if name.endswith(one)) for one in wanted]
    return np.array(bitmap, np.float32)[..., numbers]


def compare(file: Path, theirs: dict[str, Any], folder: Path, *, sky: bool = False) -> Row:
    """An import of a file beside what Blender said of it."""
    made, scene = imported(file, folder, sky=sky)
    lamps = {name for name, owner in made.objects.items() if owner not in theirs["objects"]}
    sheets = [shape for shape in scene.shapes() if not shape.id().endswith("_back")]
    shapes = [shape for shape in sheets if file.suffix != ".blend" or shape.id() not in lamps]
    low = np.min([np.array(shape.bbox().min) for shape in shapes], axis=0)
    high = np.max([np.array(shape.bbox().max) for shape in shapes], axis=0)
    bounds = np.stack([low, high]) - np.array([theirs["low"], theirs["high"]])
    moved = np.round(bounds[0]) if np.abs(bounds).max() > 1 else np.zeros(3)  # a scene far from the origin
    ratios, differences = [], []
    for view, exr in zip(theirs["views"], theirs["pictures"], strict=True):
        ours, other = picture(scene, (np.array(view) + moved).tolist()), cycles_picture(exr)
        seen = ours[..., 6] > 0
        means = [float(values[seen, :3].mean()) if seen.any() else 0.0 for values in (ours, other)]
        ratios.append(np.nan if max(means) < 1e-6 else means[0] / max(means[1], 1e-9))
        differences.append(np.abs(ours[seen, 3:6] - other[seen, 3:]).ravel())
    objects = theirs["objects"].values()
    return Row(
        f"{file.parent.name}/{file.name}",
        reader_of(file).__module__.rsplit(".", 1)[1],
        (sum(shape.face_count() for shape in shapes if shape.is_mesh()), sum(each["triangles"] for each in objects)),
        (sum(float(shape.surface_area()[0]) for shape in shapes), sum(each["area"] for each in objects)),
        float(np.abs(bounds - moved).max() / np.linalg.norm(high - low)),
        float(np.percentile(np.concatenate([[0.0], *differences]), 90)),
        tuple(ratios),
    )


def compare_all(files: list[Path], folder: Path) -> Iterator[Row]:
    """A row for each file, under a white sky; Blender is started once."""
    jobs = [{"look": str(file), "pictures": str(folder / f"cycles-{k}"), "sky": True} for k, file in enumerate(files)]
    for number, (file, theirs) in enumerate(zip(files, run_in_blender(jobs, folder), strict=True)):
        yield compare(file, theirs, folder / str(number), sky=True)


LAMPS: dict[str, dict[str, Any]] = {
    "point": {"kind": "POINT"},
    "point-radius": {"kind": "POINT", "set": {"shadow_soft_size": 0.15}, "scale": (2, 2, 2)},
    "point-exposure": {"kind": "POINT", "set": {"exposure": -1.5, "color": (1, 0.5, 0.1)}},
    "point-unnormalized": {"kind": "POINT", "set": {"normalize": False, "energy": 10}},
    "point-temperature": {"kind": "POINT", "set": {"use_temperature": True, "temperature": 3000}},
    "point-nodes": {"kind": "POINT", "nodes": {"Color": (1, 0.5, 0.25, 1), "Strength": 3}},
    "point-blackbody": {"kind": "POINT", "nodes": {"Color": ["ShaderNodeBlackbody", 2500], "Strength": 2}},
    "point-value": {"kind": "POINT", "nodes": {"Strength": ["ShaderNodeValue", 4]}},
    "point-falloff": {"kind": "POINT", "nodes": {"Strength": ["ShaderNodeLightFalloff", 2]}},
    "point-mix": {"kind": "POINT", "nodes": {"Strength": ["ShaderNodeMix", 0.25, None, 3.0, 5.0]}},
    "point-instanced": {"kind": "POINT", "place": "instanced"},
    "point-collection": {"kind": "POINT", "place": "collection"},
    "spot": {"kind": "SPOT", "set": {"spot_size": radians(80), "spot_blend": 0.5}, "rotation": (0.2, 0.1, 0)},
    "spot-half": {"kind": "SPOT", "set": {"spot_size": pi, "spot_blend": 0.3}},
    "spot-radius": {"kind": "SPOT", "set": {"spot_size": radians(70), "spot_blend": 0.3, "shadow_soft_size": 0.1}},
    "spot-scaled": {"kind": "SPOT", "set": {"spot_size": radians(50)}, "scale": (2, 1, 1.2), "rotation": (0, 0.2, 0.5)},
    "sun": {"kind": "SUN", "set": {"energy": 3}, "rotation": (0.4, 0.3, 0)},
    "sun-nodes": {"kind": "SUN", "set": {"energy": 3}, "nodes": {"Color": (1, 0.5, 0.25, 1), "Strength": 2}},
    "sun-soft": {"kind": "SUN", "set": {"energy": 3, "angle": radians(20)}, "rotation": (0.4, 0.3, 0)},
    "sun-unnormalized": {"kind": "SUN", "set": {"energy": 30, "angle": radians(40), "normalize": False}},
    "area": {"kind": "AREA", "set": {"size": 0.5}},
    "area-scaled": {"kind": "AREA", "set": {"size": 0.5}, "scale": (2, 0.5, 3), "rotation": (0.3, 0.2, 0.1)},
    "area-rectangle": {"kind": "AREA", "set": {"shape": "RECTANGLE", "size": 0.8, "size_y": 0.2}},
    "area-disk": {"kind": "AREA", "set": {"shape": "DISK", "size": 0.6, "size_y": 0.1, "exposure": 1}},
    "area-ellipse": {"kind": "AREA", "set": {"shape": "ELLIPSE", "size": 0.6, "size_y": 0.3, "normalize": False}},
    "area-spread": {"kind": "AREA", "set": {"size": 0.4, "spread": radians(60)}},
    "area-spread-disk": {"kind": "AREA", "set": {"shape": "DISK", "spread": radians(100)}, "scale": (2, 1, 1)},
    "world": {"kind": "POINT", "set": {"energy": 0}, "world": {"Color": (0.2, 0.5, 1, 1), "Strength": 2}},
    "world-map": {"kind": "POINT", "set": {"energy": 0}, "world": {"Color": ["ShaderNodeTexCoord"], "Strength": 1}},
    "world-sky": {"kind": "POINT", "set": {"energy": 0}, "world": {"Color": ["ShaderNodeTexSky"], "Strength": 0.1}},
}
"""Lamps that a room of `blender_render.py` gets, one each."""

VIEWS = [[[3.8, 2.1, -0.2], [1.8, 0.5, -1.2]], [[0.3, 1.9, -0.3], [3.5, 0.9, -2.6]]]
"""Where rooms with a lamp are looked at from, and to."""


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of the rooms, and what Blender says of each."""
    folder = tmp_path_factory.mktemp("rooms")
    makes = [{"make": str(folder / f"{name}.blend"), "lamp": lamp} for name, lamp in LAMPS.items()]
    looks = [
        {"look": job["make"], "views": VIEWS, "pictures": str(folder / f"cycles-{name}")}
        for job, name in zip(makes, LAMPS, strict=True)
    ]
    return folder, dict(zip(LAMPS, run_in_blender(makes + looks, folder)[len(makes) :], strict=True))


@pytest.mark.parametrize("name", LAMPS)
def test_a_lamp_of_blender_lights_a_room_as_in_cycles(rooms: tuple[Path, dict[str, Any]], name: str) -> None:
    folder, theirs = rooms
    row = compare(folder / f"{name}.blend", theirs[name], folder / name)
    print(row)
    assert row.triangles[0] == row.triangles[1]
    assert row.area[0] == pytest.approx(row.area[1], rel=1e-5)
    assert row.box < 1e-6
    assert row.albedo < 0.01
    assert row.radiance == pytest.approx([1.0, 1.0], abs=0.05)


if __name__ == "__main__":
    import mitsuba

    mitsuba.set_variant("llvm_ad_rgb")
    with TemporaryDirectory() as folder:
        for file_row in compare_all([Path(name) for name in sys.argv[1:]], Path(folder)):
            sys.stdout.write(f"{file_row}\n")
