"""Which points a view sees: against float64 arithmetic on the stored triangles, and where the answer is known.

Shape letters: N points, F triangles.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from photonfarm.core.records import STATIC, BasePointCloud, Geometry, Photons, Visibility
from photonfarm.renderer.jobs.render import visibility_of
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.gbuffer import find_seen_points
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.modification import Modification, rebuild, sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec, parse_spec
from photonfarm.scene.view import View, sample_view

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

# ------------------------------------------------------------------------------------------------------- the oracle


def triangles_of(geometry: Geometry, modification: Modification) -> F64:
    """The corners of the triangles that are present, where they stand, (F, 3, 3)."""
    corners = geometry.vertices[geometry.faces].astype(np.float64)
    group = geometry.shape_group[geometry.face_shape]
    moves = group != STATIC
    corners[moves] += modification.translation[group[moves]].astype(np.float64)[:, None]
    present = np.ones(len(group), np.bool_)
    present[moves] = modification.present[group[moves]]
    return corners[present]


def met(origin: F64, towards: F64, triangles: F64) -> Mask:
    """Return whether segments from `origin` (N, 3), as long as `towards` (N, 3), meet a triangle (F, 3, 3), (N,).

    Möller and Trumbore, 1997: Cramer's rule for origin + t · towards = a + u (b − a) + v (c − a).
    """
    found = np.zeros(len(origin), np.bool_)
    a, b, c = triangles.transpose(1, 0, 2)
    ab, ac = b - a, c - a
    for i, (start, way) in enumerate(zip(origin, towards, strict=True)):
        p = np.cross(way, ac)
        determinant = (ab * p).sum(axis=1)
        crossed = determinant != 0
        inverse = 1 / np.where(crossed, determinant, 1)
        s = start - a
        q = np.cross(s, ab)
        u, v, t = (s * p).sum(axis=1) * inverse, q @ way * inverse, (q * ac).sum(axis=1) * inverse
        found[i] = (crossed & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)).any()
    return found


def seen_by(view: View, spec: SceneSpec, position: NDArray[Any], triangles: F64, self_hit: float = 1e-4) -> Mask:
    """The definition as docs/store-format.md has it, in float64, (N,)."""
    origin, target, up = (np.array(v, np.float64) for v in (view.origin, view.target, spec.view.up))
    forward = (target - origin) / np.linalg.norm(target - origin)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    down = np.cross(forward, right)
    focal = spec.film.width / 2 / np.tan(np.radians(spec.view.fov_deg) / 2)
    d = position.astype(np.float64) - origin
    z = d @ forward
    seen = (spec.view.near < z) & (z < spec.view.far)
    column = np.floor(focal * (d[seen] @ right) / z[seen] + spec.film.width / 2)
    row = np.floor(focal * (d[seen] @ down) / z[seen] + spec.film.height / 2)
    seen[seen] = (column >= 0) & (column < spec.film.width) & (row >= 0) & (row < spec.film.height)
    start = spec.view.near / z[seen, None]
    seen[seen] = ~met(origin + d[seen] * start, d[seen] * (1 - self_hit - start), triangles)
    return seen


@dataclass(frozen=True)
class Looked:
    """One view: what the renderer says, and the oracle by triangles."""

    spec: SceneSpec
    view: View
    cloud: BasePointCloud
    modification: Modification
    photons: Photons
    found: Visibility
    triangles: F64

    @property
    def position(self) -> NDArray[np.float32]:
        """The positions of the points that may be seen, and of the photons, (N, 3)."""
        position, present = rebuild(self.cloud, self.modification)
        return np.concatenate([position[present], self.photons.position[self.photons.bounce >= 0]])

    @property
    def seen(self) -> Mask:
        _, present = rebuild(self.cloud, self.modification)
        return np.concatenate([self.found.points[present], self.found.photons[self.photons.bounce >= 0]])


@pytest.fixture(scope="module")
def loaded() -> LoadedScene:
    spec = load_spec("room")
    film = spec.film.model_copy(update={"width": 64, "height": 48})
    photons = spec.photons.model_copy(update={"paths": 64})
    return LoadedScene.load(spec.model_copy(update={"film": film, "photons": photons, "points": 600}))


@pytest.fixture(scope="module")
def looked(loaded: LoadedScene) -> list[Looked]:
    """Eight views of four random configurations of the built-in room, groups removed in them."""
    geometry, cloud = loaded.base()
    return list(look(loaded, geometry, cloud))


def look(loaded: LoadedScene, geometry: Geometry, cloud: BasePointCloud) -> Iterator[Looked]:
    spec = loaded.spec
    for i in range(8):
        modification = sample_modification(spec, 0, i // 2)
        loaded.apply(modification)
        view = sample_view(spec, modification.key(spec.radiance_id), 0, i)
        photons = loaded.photons(i // 2)
        assert photons is not None
        (found,) = visibility_of(loaded, [view], rebuild(cloud, modification), photons)
        yield Looked(spec, view, cloud, modification, photons, found, triangles_of(geometry, modification))


def test_the_bits_are_those_of_brute_force_on_the_stored_triangles(looked: list[Looked]) -> None:
    """Some 6000 points and photons, one in six of them seen.

    Where they differ, the line grazes something: the oracle's answer too is another one where it ends a little earlier
    or later, or a ten thousandth of its length to the side.
    """
    exact = [seen_by(one.view, one.spec, one.position, one.triangles) for one in looked]
    differs = [one.seen != by_hand for one, by_hand in zip(looked, exact, strict=True)]
    assert sum(map(len, exact)) > 6000
    assert 0.1 < np.concatenate(exact).mean() < 0.3
    assert np.concatenate(differs).mean() <= 0.001
    for one, wrong in zip(looked, differs, strict=True):
        assert graze(one, one.position[wrong]).all()


def graze(one: Looked, position: NDArray[np.float32]) -> Mask:
    """Return whether the oracle's answer for points (N, 3) hangs on a ten thousandth of their distance, (N,)."""
    answers = [seen_by(one.view, one.spec, position, one.triangles, self_hit) for self_hit in (1e-5, 1e-4, 1e-3)]
    distance = np.linalg.norm(position - one.view.origin, axis=1, keepdims=True)
    for side in np.concatenate([np.eye(3), -np.eye(3)]):
        answers += [seen_by(one.view, one.spec, position + 1e-4 * distance * side, one.triangles)]
    return np.any([answer != answers[1] for answer in answers], axis=0)


def test_points_of_removed_groups_and_empty_slots_are_never_seen(looked: list[Looked]) -> None:
    """Some would be, where they stand at rest and were they there."""
    would_be = 0
    for one in looked:
        position, present = rebuild(one.cloud, one.modification)
        assert not one.found.points[~present].any()
        assert not one.found.photons[one.photons.bounce < 0].any()
        would_be += seen_by(one.view, one.spec, position[~present], one.triangles).sum()
    assert would_be > 0
    assert any((one.photons.bounce < 0).any() for one in looked)


def test_neither_another_view_nor_an_edit_compiles_a_kernel(loaded: LoadedScene, looked: list[Looked]) -> None:
    import drjit as dr

    used = []
    for one in looked:
        loaded.apply(one.modification)
        points = rebuild(one.cloud, one.modification)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            visibility_of(loaded, [one.view], points, one.photons)
            used.append({kernel["hash"] for kernel in dr.kernel_history() if "hash" in kernel})
    assert all(used)
    assert set.union(*used) == used[0]


# ---------------------------------------------------------------------------------------- where the answer is known

ALONG_Z = View(np.array([0, 0, 3], np.float32), np.array([0, 0, 0], np.float32))


def spec(near: float = 0.01, far: float = 100) -> SceneSpec:
    """24 × 16 pixels, 60° across: at distance 1, ±0.577 wide and ±0.385 high."""
    point = {"min": [-1, -1, -1], "max": [1, 1, 1]}
    described = {"origin": point, "look_at": point, "fov_deg": 60, "near": near, "far": far}
    film = {"width": 24, "height": 16}
    return parse_spec({"name": "v", "scene": {"builtin": "cornell"}, "view": described, "film": film}, where="test")


def sees(*position: tuple[float, float, float], bsdf: str = "diffuse", **limits: float) -> list[bool]:
    """The eye at (0, 0, 3) looks past a square at the origin, ±1 across and facing the eye."""
    mi = backend.load(1)
    scene = mi.load_dict({"type": "scene", "square": {"type": "rectangle", "bsdf": {"type": bsdf}}}, optimize=False)
    return find_seen_points(scene, [ALONG_Z], spec(**limits), np.array(position, np.float32))[0].tolist()


@pytest.mark.parametrize("bsdf", ["diffuse", "dielectric", "null"])
def test_a_surface_hides_what_is_behind_it_and_neither_itself_nor_what_is_before_it(bsdf: str) -> None:
    before, on_it, behind = (0.1, 0.1, 1), (0.1, 0.1, 0), (0.1, 0.1, -1)
    assert sees(before, on_it, behind, bsdf=bsdf) == [True, True, False]
    touching, past = (0, 0, -0.5e-4 * 3), (0, 0, -2e-4 * 3)
    assert sees(touching, past, bsdf=bsdf) == [True, False]


def test_what_is_outside_the_image_is_not_seen() -> None:
    """The points are at z = 2, a distance of 1."""
    edge_x, edge_y = np.tan(np.radians(30)), np.tan(np.radians(30)) * 16 / 24
    inside = [(0.999 * x, 0.999 * y, 2) for x in (-edge_x, edge_x) for y in (-edge_y, edge_y)]
    outside = [(1.001 * edge_x, 0, 2), (-1.001 * edge_x, 0, 2), (0, 1.001 * edge_y, 2), (0, -1.001 * edge_y, 2)]
    assert sees(*inside, *outside) == [True] * 4 + [False] * 4
    assert sees((0, 0, 4), (0, 0, 3), (0.1, 0, 3)) == [False] * 3  # behind the eye, in it, and beside it


def test_between_the_planes_only_and_what_is_before_the_near_plane_hides_nothing() -> None:
    assert sees((0, 0, 1), (0, 0, -2), near=3.5, far=4.5) == [False, False]
    assert sees((0, 0, -1), (0.4, 0.4, -1), near=3.5, far=4.5) == [True, True]
    assert sees((0, 0, -1), near=2.5, far=4.5) == [False]
