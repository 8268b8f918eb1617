"""Modification sampling, supplement 2.4. Significance of the statistical tests: 1e-4 each, seeds fixed."""

import numpy as np
import pytest
from scipy import stats

from photonfarm.scene.modification import Modification, rest, sample_modification
from photonfarm.scene.spec import SceneSpec

COUNT = 4000


@pytest.fixture
def sampled(dynamic_spec: SceneSpec) -> list[Modification]:
    return [sample_modification(dynamic_spec, 0, i) for i in range(COUNT)]


def test_objects_are_removed_with_probability_one_fifth_each_and_lights_never(sampled: list[Modification]) -> None:
    removed = ~np.array([m.present for m in sampled])
    for i in range(3):
        assert stats.binomtest(int(removed[:, i].sum()), COUNT, 0.2).pvalue > 1e-4
    assert not removed[:, 3].any()


def test_removals_of_different_objects_are_independent(sampled: list[Modification]) -> None:
    removed = ~np.array([m.present for m in sampled])[:, :3]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        table = np.histogram2d(removed[:, i], removed[:, j], bins=2)[0]
        assert stats.chi2_contingency(table).pvalue > 1e-4


def test_positions_are_uniform_in_the_box_along_every_axis(
    dynamic_spec: SceneSpec, sampled: list[Modification]
) -> None:
    for i, group in enumerate(dynamic_spec.groups):
        there = np.array([m.translation[i] for m in sampled if m.present[i]]) + np.array(group.at)
        for axis in range(3):
            low, high = group.box.low[axis], group.box.high[axis]
            if low == high:
                assert np.allclose(there[:, axis], low, atol=1e-6)
            else:
                assert stats.kstest(there[:, axis], "uniform", (low, high - low)).pvalue > 1e-4


def test_positions_are_independent_between_groups_and_axes(sampled: list[Modification]) -> None:
    everything = [m for m in sampled if m.present.all()]
    free = np.array([m.translation for m in everything]).reshape(len(everything), -1)
    free = free[:, free.std(axis=0) > 1e-3]
    correlation = np.corrcoef(free.T) - np.eye(free.shape[1])
    assert np.abs(correlation).max() * np.sqrt(len(everything)) < 4.5


def test_a_static_scene_has_only_its_rest_state(static_spec: SceneSpec) -> None:
    modification = sample_modification(static_spec, 0, 7)
    assert modification.vector.shape == (0, 4)
    assert modification.key("id") == rest(static_spec).key("id")


def test_two_configurations_that_differ_only_in_where_a_removed_object_would_be_are_one(
    sampled: list[Modification],
) -> None:
    gone = [m for m in sampled if not m.present[0]]
    assert all(not m.translation[0].any() for m in gone)


def test_the_master_seed_and_the_index_choose_the_configuration(dynamic_spec: SceneSpec) -> None:
    keys = {sample_modification(dynamic_spec, s, i).key("id") for s in (0, 1) for i in range(10)}
    assert len(keys) == 20
    again = sample_modification(dynamic_spec, 0, 3)
    assert again.key("id") == sample_modification(dynamic_spec, 0, 3).key("id")
