"""Point cloud sampling, supplement 2.3 and 2.1. Significance of the statistical tests: 1e-4 each, seeds fixed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from photonfarm.core.keys import Stream, make_key
from photonfarm.core.records import STATIC, BasePointCloud, Geometry, Pivots
from photonfarm.scene.modification import (
    Modification,
    draw,
    rebuild,
    rebuild_surfaces,
    sample_modification,
    sample_surface,
)
from photonfarm.scene.spec import SceneSpec

COUNT = 40_000


@pytest.fixture
def geometry() -> Geometry:
    """Four shapes of 1, 0 (degenerate), 2 and 3 triangles with interleaved faces and different areas."""
    vertices = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [5, 2, 0], [5, 0, 3], [9, 0, 0], [9, 0, 4], [9, 1, 1]], np.float32
    )
    faces = np.array([[3, 4, 5], [0, 1, 2], [6, 7, 8], [6, 6, 7], [5, 4, 3], [0, 2, 8], [1, 2, 3]], np.uint32)
    face_shape = np.array([2, 0, 3, 1, 2, 3, 3], np.int32)
    return Geometry(vertices, faces, face_shape, np.array([0, 1, STATIC, 2], np.int16))


def sampled(geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    return sample_surface(geometry, COUNT, Stream(make_key("cloud"), "surface"))


def test_triangles_are_drawn_in_proportion_to_their_area(geometry: Geometry) -> None:
    face, _ = sampled(geometry)
    area = geometry.areas()
    count = np.bincount(face, minlength=len(area))
    alive = area > 0
    assert not count[~alive].any()
    assert stats.chisquare(count[alive], COUNT * area[alive] / area.sum()).pvalue > 1e-4


def test_points_are_uniform_over_the_four_middle_triangles(geometry: Geometry) -> None:
    _, weights = sampled(geometry)
    assert np.allclose(weights.sum(axis=1), 1)
    assert weights.min() >= 0
    part = np.where(weights.max(axis=1) > 0.5, weights.argmax(axis=1), 3)
    assert stats.chisquare(np.bincount(part, minlength=4)).pvalue > 1e-4


def test_the_index_drawn_is_the_first_whose_cdf_reaches_u() -> None:
    weights = np.array([0.0, 1.0, 0.0, 2.0, 1.0, 0.0])  # cdf 0 .25 .25 .75 1 1
    u = np.array([0.0, 0.1, 0.25, 0.2500001, 0.75, 0.76, 1 - 2**-53])
    assert draw(weights, u).tolist() == [1, 1, 1, 3, 3, 4, 4]


@pytest.fixture
def base() -> BasePointCloud:
    rng = np.random.default_rng(0)
    position = rng.normal(size=(500, 3)).astype(np.float32)
    group = rng.integers(-1, 4, 500).astype(np.int16)
    return BasePointCloud(position, position, position, position, group, np.zeros(500, np.uint32))


def test_points_move_with_their_group_and_no_others_do(base: BasePointCloud, dynamic_spec: SceneSpec) -> None:
    for index in range(20):
        modification = sample_modification(dynamic_spec, 0, index)
        position, present = rebuild(base, modification)
        static = base.group == STATIC
        assert np.array_equal(position[static], base.position[static])
        assert present[static].all()
        for g in range(4):
            of_group = base.group == g
            moved = position[of_group] - base.position[of_group]
            assert np.abs(moved - modification.translation[g]).max() < 1e-6
            assert (present[of_group] == modification.present[g]).all()


def test_points_turn_about_the_at_of_their_group_before_they_move(base: BasePointCloud) -> None:
    """As docs/store-format.md says, with y up: what lies along +x comes to lie along −z by a quarter of a turn."""
    at = np.arange(12.0).reshape(4, 3)
    vector = np.zeros((4, 9), np.float32)
    vector[:, 3:] = 1, 0, 1, 1, 1, 1
    vector[1, 4], vector[2, [0, 4]], vector[3, 5:] = 90, (1, -30), (2, 1, 0.5, 0)
    modification = Modification.from_vector(vector)
    turning = replace(base, pivots=Pivots(at, np.array([0.0, 1, 0])))
    (position, _), (normal, emission) = rebuild(turning, modification), rebuild_surfaces(turning, modification)
    for g, degrees in ((1, 90), (2, -30)):
        own, angle = base.group == g, np.radians(degrees)
        x, y, z = (base.position[own] - at[g]).T
        turned = [np.cos(angle) * x + np.sin(angle) * z, y, np.cos(angle) * z - np.sin(angle) * x]
        np.testing.assert_allclose(position[own], np.transpose(turned) + at[g] + vector[g, :3], atol=1e-5)
        x, y, z = base.normal[own].T
        turned = [np.cos(angle) * x + np.sin(angle) * z, y, np.cos(angle) * z - np.sin(angle) * x]
        np.testing.assert_allclose(normal[own], np.transpose(turned), atol=1e-6)
    others = ~np.isin(base.group, (1, 2))
    np.testing.assert_array_equal(position[others], base.position[others])
    np.testing.assert_array_equal(normal[others], base.normal[others])
    dimmed = base.group == 3
    np.testing.assert_array_equal(emission[dimmed], base.emission[dimmed] * np.float32([2, 1, 0]))
    np.testing.assert_array_equal(emission[~dimmed], base.emission[~dimmed])


def test_a_static_scene_has_its_base_cloud(base: BasePointCloud, static_spec: SceneSpec) -> None:
    position, present = rebuild(base, sample_modification(static_spec, 0, 0))
    assert np.array_equal(position, base.position)
    assert present.all()
