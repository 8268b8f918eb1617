"""A scene whose clean images are known in closed form: a box in a room with a point light, rendered with numpy.

The room is the cube [-1, 1]³; a small cube stands anywhere on its floor and may be removed; a light that shines
downward with the cosine hangs anywhere under the ceiling, in the middle of a small emitting quad. Walls and cube are
diffuse, light is direct only. Half-estimates are the clean image times gamma noise of mean 1, hence unbiased.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from photonfarm.shared.keys import Key, Stream, make_key
from photonfarm.shared.modification import Modification, sample_modification
from photonfarm.shared.pointcloud import rebuild, sample_surface
from photonfarm.shared.records import F32, STATIC, BasePointCloud, Geometry, ViewBuffers
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.store import Figures, SceneStore, Store
from photonfarm.shared.view import Camera, View, sample_view
from photonfarm.trainer.settings import NetworkSettings, TrainSettings

CUBE_HALF = 0.3
CUBE_REST = np.array([0.0, -0.7, 0.0])
LIGHT_HALF = 0.15
LIGHT_REST = np.array([0.0, 0.95, 0.0])
INTENSITY = np.array([6.0, 5.5, 5.0])
GLOW = np.array([2.0, 1.9, 1.8])
WALLS = np.array([[0.8, 0.2, 0.2], [0.2, 0.8, 0.2], [0.7, 0.7, 0.7], [0.8, 0.8, 0.8], [0.3, 0.4, 0.8], [0.8, 0.8, 0.5]])
CUBE_ALBEDO = np.array([0.6, 0.5, 0.2])


def analytic_spec(size: int = 32, points: int = 1024, *, moving: bool = True) -> SceneSpec:
    box = {"min": [-0.8, -0.8, -0.8], "max": [0.8, 0.8, 0.8]}
    described = {
        "name": "analytic",
        "content": "analytic",
        "scene": {"builtin": "cornell"},
        "view": {"origin": box, "look_at": box, "fov_deg": 75, "near": 0.05, "far": 10},
        "film": {"width": size, "height": size},
        "photons": {"paths": 0},
        "points": points,
    }
    cube = {"name": "cube", "shapes": ["cube"], "at": CUBE_REST.tolist()}
    cube["box"] = {"min": [-0.65, -0.7, -0.65], "max": [0.65, -0.7, 0.65]}
    light = {"name": "light", "shapes": ["light"], "at": LIGHT_REST.tolist()}
    light["box"] = {"min": [-0.5, 0.95, -0.5], "max": [0.5, 0.95, 0.5]}
    if moving:
        described |= {"objects": [cube], "lights": [light]}
    return SceneSpec.model_validate(described)


# ---------------------------------------------------------------------------------------------------------- rendering


def _slab(origin: NDArray, direction: NDArray, centre: NDArray, half: float) -> tuple[NDArray, NDArray]:
    """Distances at which rays enter and leave a cube; (…,) each."""
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = ((centre + sign * half - origin) / direction for sign in (-1, 1))
    return np.fmax.reduce(np.fmin(low, high), axis=-1), np.fmin.reduce(np.fmax(low, high), axis=-1)


def _face(point: NDArray, centre: NDArray, half: float) -> tuple[NDArray, NDArray]:
    """Index 0…5 and outward normal of the cube's face that a point lies on."""
    offset = (point - centre) / half
    axis = np.abs(offset).argmax(axis=-1)
    sign = np.sign(np.take_along_axis(offset, axis[..., None], axis=-1))[..., 0]
    return 2 * axis + (sign > 0), np.eye(3)[axis] * sign[..., None]


def render(spec: SceneSpec, modification: Modification, view: View) -> tuple[F32, ViewBuffers]:
    """The clean image (H, W, 3) and the image-space buffers."""
    shift, present = np.zeros((2, 3)), np.ones(2, bool)
    if spec.groups:
        shift, present = modification.translation.astype(np.float64), modification.present
    cube, light = CUBE_REST + shift[0], LIGHT_REST + shift[1]
    camera = Camera.of(view, spec)
    ray = camera.rays().astype(np.float64)
    eye = camera.origin

    distance = _slab(eye, ray, np.zeros(3), 1.0)[1]
    wall, normal = _face(eye + ray * distance[..., None], np.zeros(3), 1.0)
    albedo, normal = WALLS[wall], -normal
    enter, leave = _slab(eye, ray, cube, CUBE_HALF)
    on_cube = present[0] & (enter < leave) & (leave > 0)
    reach = np.where(enter > 0, enter, leave)
    on_cube &= reach < distance
    distance = np.where(on_cube, reach, distance)
    point = eye + ray * distance[..., None]
    normal = np.where(on_cube[..., None], _face(point, cube, CUBE_HALF)[1], normal)
    albedo = np.where(on_cube[..., None], CUBE_ALBEDO, albedo)

    with np.errstate(divide="ignore", invalid="ignore"):
        to_quad = (light[1] - eye[1]) / ray[..., 1]
    at_quad = eye + ray * to_quad[..., None]
    on_light = (to_quad > 0) & (to_quad < distance) & (np.abs(at_quad - light)[..., [0, 2]].max(axis=-1) < LIGHT_HALF)

    to_light = light - point
    squared = (to_light**2).sum(axis=-1)
    to_light /= np.sqrt(squared)[..., None]
    enter, leave = _slab(point + 1e-4 * normal, to_light, cube, CUBE_HALF)
    shadow = present[0] & (enter < leave) & (leave > 0) & (enter < np.sqrt(squared))
    cosines = np.clip((normal * to_light).sum(axis=-1), 0, None) * np.clip(to_light[..., 1], 0, None)
    radiance = albedo / np.pi * INTENSITY * (~shadow * cosines / squared)[..., None]

    distance = np.where(on_light, to_quad, distance)
    radiance = np.where(on_light[..., None], np.where(eye[1] < light[1], GLOW, 0), radiance)
    albedo = np.where(on_light[..., None], 0, albedo)
    normal = np.where(on_light[..., None], [0, -1, 0], normal)
    depth = distance * (ray @ camera.forward)
    buffers = ViewBuffers(depth.astype(np.float32), albedo.astype(np.float32), normal.astype(np.float32))
    return radiance.astype(np.float32), buffers


def analytic_base(spec: SceneSpec) -> tuple[Geometry, BasePointCloud]:
    """Walls, cube and light quad as triangles, and the base cloud sampled from them."""
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    quads = [np.flatnonzero(corners[:, axis] == side)[[0, 1, 3, 2]] for axis in range(3) for side in (-1, 1)]
    quad = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
    vertices = np.concatenate([corners, CUBE_REST + CUBE_HALF * corners, LIGHT_REST + LIGHT_HALF * quad])
    squares = np.array([*quads, *(8 + np.array(quads)), [16, 17, 18, 19]])
    faces = squares[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    shape_group = np.array([STATIC, 0, 1] if spec.groups else [STATIC] * 3, np.int16)
    geometry = Geometry(
        vertices.astype(np.float32), faces.astype(np.uint32), np.repeat([0, 1, 2], [12, 12, 2]).astype(np.int32),
        shape_group,
    )  # fmt: skip
    face, weight = sample_surface(geometry, spec.points, Stream(make_key(spec.scene_id), "cloud"))
    position = (vertices[faces[face]] * weight[..., None]).sum(axis=1)
    shape = geometry.face_shape[face]
    wall, outward = _face(position, np.zeros(3), 1.0)
    side = _face(position, CUBE_REST, CUBE_HALF)[1]
    normal = np.select([shape[:, None] == 0, shape[:, None] == 1], [-outward, side], np.array([0.0, -1, 0]))
    albedo = np.select([shape[:, None] == 0, shape[:, None] == 1], [WALLS[wall], CUBE_ALBEDO], 0.0)
    emission = np.where(shape[:, None] == 2, GLOW, 0.0)
    columns = (x.astype(np.float32) for x in (position, normal, albedo, emission))
    return geometry, BasePointCloud(*columns, shape_group[shape], face)


# ----------------------------------------------------------------------------------------------------------- a source


@dataclass(frozen=True)
class AnalyticSample:
    row: int
    modification: Modification
    view: View
    radiance: F32
    buffers: ViewBuffers
    pass_: int


class AnalyticSource:
    """Samples of the analytic scene, `views` of each configuration, released `per_look` rows at each refresh."""

    def __init__(self, spec: SceneSpec, samples: int, *, views: int = 1, noise: float = 1.0, per_look: int = 1 << 30):
        self.spec, self._samples, self._views, self._noise, self._per_look = spec, samples, views, noise, per_look
        self._base = analytic_base(spec)
        self._released = 0
        self.reads: list[int] = []

    def ready(self) -> bool:
        return True

    def base(self) -> tuple[Geometry, BasePointCloud]:
        return self._base

    def planned(self) -> int:
        return self._samples

    def refresh(self) -> NDArray[np.int64]:
        before = self._released
        self._released = min(self._samples, before + self._per_look)
        return np.arange(before, self._released)

    def taken_back(self) -> NDArray[np.int64]:
        return np.zeros(0, np.int64)

    def modification(self, row: int) -> Modification:
        return sample_modification(self.spec, 0, row // self._views)

    def view(self, row: int) -> View:
        return sample_view(self.spec, self.modification(row).key(self.spec.scene_id), 0, row)

    def modification_key(self, row: int) -> Key:
        return self.modification(row).key(self.spec.scene_id)

    def view_key(self, row: int) -> Key:
        return make_key(self.modification_key(row), self.view(row).vector)

    def modification_keys(self, rows: Sequence[int]) -> list[Key]:
        return [self.modification_key(row) for row in rows]

    def view_keys(self, rows: Sequence[int]) -> list[Key]:
        return [self.view_key(row) for row in rows]

    def cloud_at(self, row: int) -> tuple[F32, NDArray[np.bool_]]:
        """The cloud of a row's configuration: positions and visibility flags."""
        return rebuild(self._base[1], self.modification(row))

    def sees(self, row: int, position: F32) -> NDArray[np.bool_]:
        """Which points the eye of a row sees, by an exact query: nothing lies between, (P,)."""
        eye, modification = self.view(row).origin.astype(np.float64), self.modification(row)
        to_point = position - eye
        enter, leave = _slab(eye, to_point, CUBE_REST + modification.translation[0], CUBE_HALF)
        first = np.where(enter > 0, enter, leave)
        behind_cube = modification.present[0] & (enter < leave) & (leave > 0) & (first < 1 - 1e-5)
        light = LIGHT_REST + modification.translation[1]
        crossing = (light[1] - eye[1]) / to_point[:, 1]
        at_quad = np.abs(eye + to_point * crossing[:, None] - light)[:, [0, 2]].max(axis=1)
        behind_light = (crossing > 0) & (crossing < 1 - 1e-5) & (at_quad < LIGHT_HALF)
        return ~behind_cube & ~behind_light

    def clean(self, row: int) -> F32:
        return render(self.spec, self.modification(row), self.view(row))[0]

    def read(self, row: int) -> AnalyticSample:
        self.reads.append(row)
        modification, view = self.modification(row), self.view(row)
        clean, buffers = render(self.spec, modification, view)
        return AnalyticSample(row, modification, view, noisy(clean, row, self._noise), buffers, 0)


def commit_job(scene: SceneStore, job: int) -> bool:
    """Write one job of a store, its images analytic; as a render worker does."""
    rows, viewed = scene.job_rows(job), set()
    with scene.job_writer(job) as out:
        for sample in rows.samples:
            clean, seen = render(scene.spec, rows.modifications[sample.modification_row], rows.views[sample.view_row])
            out.radiance(sample.row, noisy(clean, sample.row, 1.0))
            if sample.view_row in rows.new_views - viewed:
                out.buffers(sample.view_row, seen)
                viewed.add(sample.view_row)
        return out.commit(Figures(core_s=0.5, wall_s=0.6, redrawn=0, worker="test", versions={"test": "1"}))


def noisy(clean: F32, seed: int, noise: float) -> F32:
    """Half-estimates A and B, (2, H, W, 3): the clean image times gamma noise of mean 1 and deviation `noise`."""
    factor = np.random.default_rng(seed).gamma(1 / noise**2, noise**2, (2, *clean.shape))
    return (clean * factor).astype(np.float32)


# ----------------------------------------------------------------------------------------------------------- fixtures


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    """Torch on one processor thread: small tensors gain nothing from more, and sums stay in one order."""
    torch.set_num_threads(1)


@pytest.fixture
def make_source() -> Callable[..., AnalyticSource]:
    """A source of so many analytic samples; how: views=, noise=, per_look=."""

    def make(samples: int, *, size: int = 16, points: int = 256, moving: bool = True, **how: Any) -> AnalyticSource:
        return AnalyticSource(analytic_spec(size, points, moving=moving), samples, **how)

    return make


@pytest.fixture
def tiny() -> Callable[..., TrainSettings]:
    """Settings of a tiny network on tiny batches, with changes."""

    def settings(**changes: Any) -> TrainSettings:
        described = {"network": NetworkSettings(width=4), "batch": 3, "hold_out": 0.25, "poll_seconds": 0.01}
        described |= {"max_steps": 12, "validate_every": 5, "checkpoint_every": 4, "validation_samples": 8}
        return TrainSettings.model_validate({**described, **changes})

    return settings


@pytest.fixture
def scene(tmp_path: Path) -> SceneStore:
    """A store's scene with its base written and nothing else."""
    scene = Store(tmp_path / "store", create=True).add(analytic_spec(16, 256))
    scene.write_base(*analytic_base(scene.spec))
    return scene


@pytest.fixture
def commit() -> Callable[[SceneStore, int], bool]:
    """What writes one job of a scene."""
    return commit_job


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Where a training run goes."""
    return tmp_path / "run"
