"""Modification sampling, supplement 2.4. Significance of the statistical tests: 1e-4 each, seeds fixed."""

import numpy as np
import pytest
from scipy import stats

from photonfarm.scene.groups import Power, Turn
from photonfarm.scene.modification import (
    Modification,
    modification_keys,
    rest,
    sample_modification,
    sample_modifications,
    turn_about,
)
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


WARM, COLD = (1.0, 0.6, 0.3), (0.8, 0.9, 1.0)


def changing(spec: SceneSpec) -> SceneSpec:
    """The same scene, whose first object turns, and whose light has powers and two colours; no other object does."""
    (light,) = spec.lights
    turning = spec.objects[0].model_copy(update={"turn": Turn(min=-30, max=60)})
    light = light.model_copy(update={"power": Power(min=0.5, max=2), "colour": (WARM, COLD)})
    return spec.model_copy(update={"objects": (turning, *spec.objects[1:]), "lights": (light,)})


def test_turns_and_powers_are_uniform_colours_are_as_likely_and_all_are_independent(dynamic_spec: SceneSpec) -> None:
    spec = changing(dynamic_spec)
    vectors = sample_modifications(spec, 0, range(COUNT))
    assert vectors.shape == (COUNT, 4, 9)
    present, turn, power = vectors[:, 0, 3] != 0, vectors[:, 0, 4], vectors[:, 3, 5]
    assert stats.kstest(turn[present], "uniform", (-30, 90)).pvalue > 1e-4
    assert stats.kstest(power, "uniform", (0.5, 1.5)).pvalue > 1e-4
    is_warm = (vectors[:, 3, 6:] == np.float32(WARM)).all(axis=1)
    assert (is_warm | (vectors[:, 3, 6:] == np.float32(COLD)).all(axis=1)).all()
    assert stats.binomtest(int(is_warm.sum()), COUNT, 0.5).pvalue > 1e-4
    columns = np.stack([turn, power, is_warm, vectors[:, 0, 0]])[:, present]
    assert np.abs(np.corrcoef(columns) - np.eye(4)).max() * np.sqrt(present.sum()) < 4.5
    at_rest = np.float32([0, 1, 1, 1, 1])
    assert (vectors[~present][:, 0, 4:] == at_rest).all()
    assert (vectors[:, 1:3, 4:] == at_rest).all()
    assert Modification.from_vector(vectors[0]).key("id") == modification_keys("id", vectors[:1])[0]


def test_a_scene_in_which_nothing_turns_or_shines_otherwise_has_the_vectors_that_it_always_had(
    dynamic_spec: SceneSpec,
) -> None:
    described = dynamic_spec.model_dump(mode="json")
    assert not {"turn", "power", "colour"} & {key for group in described["lights"] for key in group}
    assert sample_modifications(dynamic_spec, 0, range(2)).shape == (2, 4, 4)
    assert rest(dynamic_spec).further is None
    assert changing(dynamic_spec).radiance_id != dynamic_spec.radiance_id


@pytest.mark.parametrize(("up", "right"), [((0, 1, 0), (0, 0, -1)), ((0, 0, 1), (0, 1, 0)), ((0, 0, -1), (0, -1, 0))])
def test_a_quarter_of_a_turn_is_counter_clockwise_from_above(up: tuple[float, ...], right: tuple[float, ...]) -> None:
    """What lies along +x about `at` lies then where one turns to the left to."""
    at = np.array([3.0, 2.0, 1.0])
    turned = turn_about((at + np.eye(3)[:1]).astype(np.float32), 90, np.array(up, np.float64), at)
    np.testing.assert_allclose(turned[0] - at, right, atol=1e-6)
