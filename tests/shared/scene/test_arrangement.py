"""Configurations by names: what they make of the vector, how they are said, what they refuse and what they doubt."""

import numpy as np
import pytest

from photonfarm.core.errors import SpecError
from photonfarm.core.statistics import Estimate, jackknife
from photonfarm.scene.arrangement import Arrangement, Shot, describe_shot, find_doubts, list_shot
from photonfarm.scene.groups import Fov, Light, Power, Turn
from photonfarm.scene.modification import rest, sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import View, sample_view


@pytest.fixture(scope="module")
def spec() -> SceneSpec:
    return load_spec("room")


def number(spec: SceneSpec, name: str) -> int:
    return [group.name for group in spec.groups].index(name)


def test_a_group_is_placed_by_its_at_moved_from_where_it_stands_and_left_out(spec: SceneSpec) -> None:
    sofa, lamp, vase = (number(spec, name) for name in ("sofa", "lamp", "vase"))
    made = Arrangement.of(place={"sofa": np.array([-1, 0, 3])}, move={"lamp": [0.5, 0, 0]}, without=["vase"]).apply(
        spec
    )
    np.testing.assert_allclose(made.translation[sofa] + spec.groups[sofa].at, [-1, 0, 3], atol=1e-6)
    np.testing.assert_array_equal(made.translation[lamp], [0.5, 0, 0])
    assert not made.present[vase]
    again = Arrangement.of(move={"lamp": [0.5, 0, 0], "vase": [0, 0, 1]}, without=["sofa"]).apply(spec, made)
    np.testing.assert_array_equal(again.translation[[sofa, lamp, vase]], [[0, 0, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(again.present[[sofa, lamp, vase]], [False, True, True])
    others = np.delete(made.vector, [sofa, lamp, vase], axis=0)
    np.testing.assert_array_equal(others, np.delete(rest(spec).vector, [sofa, lamp, vase], axis=0))


def test_every_configuration_is_said_by_names_so_that_the_same_bits_come_of_it(spec: SceneSpec) -> None:
    for index in range(200):
        modification = sample_modification(spec, 3, index)
        view = sample_view(spec, modification.key(spec.radiance_id), 0, 0, modification)
        said = list_shot(spec, modification, view)
        assert said["fov"] == spec.view.fov_deg
        shot = Shot.of(**said)
        np.testing.assert_array_equal(shot.apply(spec).vector, modification.vector)
        np.testing.assert_array_equal(shot.view(spec).vector, view.vector)
    ranged = spec.model_copy(update={"view": spec.view.model_copy(update={"fov": Fov(min=30, max=90)})})
    for index in range(20):
        view = sample_view(ranged, b"0" * 16, 0, index)
        said = Shot.of(**list_shot(ranged, rest(spec), view))
        np.testing.assert_array_equal(said.view(ranged).vector, view.vector)
        assert f"--fov {view.fov!s}" in describe_shot(ranged, rest(spec), view)
    placed = Shot.of(place={"sofa": (0.9, 0, -0.5)}, without=["vase"], camera=(1.6, 1, 1), look_at=(0, 0.1, 0))
    words = "--place sofa=0.9,0,-0.5 --without vase --camera 1.6,1,1 --look-at 0,0.1,0"
    assert describe_shot(spec, placed.apply(spec), placed.view(spec)) == words


@pytest.fixture(scope="module")
def turning(spec: SceneSpec) -> SceneSpec:
    """The room, whose sofa turns and one of whose lights changes."""
    objects = [
        group.model_copy(update={"turn": Turn(min=-30, max=60)}) if group.name == "sofa" else group
        for group in spec.objects
    ]
    light = spec.lights[0].model_copy(update={"power": Power(min=0.5, max=2), "colour": ((1, 0.8, 0.5), (1, 1, 1))})
    return spec.model_copy(update={"objects": tuple(objects), "lights": (light, *spec.lights[1:])})


def test_angles_powers_and_colours_have_names_too(spec: SceneSpec, turning: SceneSpec) -> None:
    for index in range(100):
        modification = sample_modification(turning, 3, index)
        said = Arrangement.from_modification(turning, modification)
        np.testing.assert_array_equal(said.apply(turning).vector, modification.vector)
        assert not find_doubts(turning, modification)
        (distance,) = said.fits(turning, modification.vector[None])
        assert distance == 0
    asked = {"turn": {"sofa": 30}, "power": {"ceiling-light-1": 2}, "colour": {"ceiling-light-1": (1, 0.8, 0.5)}}
    made = Arrangement.of(**asked, move={"sofa": (0, 0, 0.1)}).apply(turning)
    np.testing.assert_array_equal(made.turn[number(spec, "sofa")], 30)
    np.testing.assert_allclose(made.light[number(spec, "ceiling-light-1")], [2, 1.6, 1])
    words = "--place sofa=1.85,0,0.4 --turn sofa=30 --power ceiling-light-1=2 --colour ceiling-light-1=1,0.8,0.5"
    assert Arrangement.from_modification(turning, made).describe() == words
    (off,) = Arrangement.of(turn={"sofa": 25}).fits(turning, made.vector[None])
    assert off == 5
    beyond = {
        "turn": {"sofa": 90},
        "power": {"ceiling-light-1": 3},
        "colour": {"ceiling-light-1": (0, 1, 0)},
    }
    assert len(find_doubts(turning, Arrangement.of(**beyond).apply(turning))) == 3
    gone = Arrangement.of(without=["sofa"]).apply(turning, made)
    assert gone.turn[number(spec, "sofa")] == 0


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"turn": {"lamp": 5}}, r"turn of 'lamp': the spec of room gives one to sofa; turn = \{.*\} in its table adds"),
        (
            {"power": {"sofa": 2}},
            r"gives one to ceiling-light-1, sky; power = \{.*\} in a table of \[\[lights\]\], if it shines, adds",
        ),
        ({"colour": {"sky": (1, 0, 0)}}, r"gives one to ceiling-light-1; colour = \["),
        (
            {"move": {"sky": (1, 0, 0)}},
            r"place of 'sky': the spec of room gives one to table, .*ceiling-light-2; at = ",
        ),
    ],
)
def test_what_a_group_lacks_in_the_spec_cannot_change(turning: SceneSpec, asked: dict[str, object], said: str) -> None:
    sky = Light(name="sky", shapes=("environment",), power=Power(min=0, max=1))
    spec = turning.model_copy(update={"lights": (*turning.lights, sky)})
    with pytest.raises(SpecError, match=said):
        Arrangement.of(**asked).apply(spec)
    assert Arrangement.of(place={"sky": (0, 0, 0)}, without=["vase", "vase"]).apply(spec).present[-1]


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"place": {"soffa": (0, 0, 0)}}, "'soffa' is no movable group of room; nearest: sofa"),
        ({"without": ["divan"]}, "'divan' is no movable group of room; its groups: table, .*, ceiling-light-1"),
        ({"place": {"sofa": (0, 0, 0)}, "without": ["sofa"]}, "'sofa': place and without contradict"),
        ({"turn": {"sofa": 30}}, "the spec of room gives one to no group; turn = "),
        ({"place": {"sofa": (0, 0)}}, r"^place of 'sofa' = \(0, 0\): three numbers are required$"),
        ({"place": {"sofa": "0,0,0"}}, "^place of 'sofa' = '0,0,0': three numbers are required$"),
        ({"place": {"sofa": (0, 0, np.nan)}}, r"^place of 'sofa' = \(0, 0, nan\): a finite number is required$"),
        ({"place": [("sofa", 0)]}, r"^place = \[.*\]: values by the names of groups are required$"),
        ({"camera": (1, 1)}, r"^camera = \(1, 1\): three numbers are required$"),
        ({"place": {"sofa": (0, 0, 1e39)}}, "1e\\+18 or less"),
        ({"power": {"sofa": 1e39}}, "or less is required"),
        ({"cls": 1}, "unknown key"),
        ({"without": "sofa"}, "a list is required"),
        ({"plaace": {}}, "unknown key; nearest: place"),
        ({"camera": (1, 1, 1), "look_at": (1, 1, 1)}, "is where it looks at"),
    ],
)
def test_what_is_impossible_is_refused(spec: SceneSpec, asked: dict[str, object], said: str) -> None:
    def stage() -> None:
        shot = Shot.of(**asked)
        shot.apply(spec)
        shot.view(spec)

    with pytest.raises(SpecError, match=said):
        stage()


def test_what_no_sample_shows_is_doubted_and_what_any_sample_may_show_is_not(spec: SceneSpec) -> None:
    for index in range(50):
        modification = sample_modification(spec, 5, index)
        view = sample_view(spec, modification.key(spec.radiance_id), 0, 0, modification)
        assert not find_doubts(spec, modification, view)
    camera = {"camera": (9, 1, 1), "look_at": (0, 5, 0), "fov": 50}
    wrong = Shot.of(place={"sofa": (0, 1, 0)}, without=["ceiling-light-1"], **camera)
    doubts = find_doubts(spec, wrong.apply(spec), wrong.view(spec))
    beginnings = [
        "sofa stands at 0,1,0, outside",
        "ceiling-light-1 is removed",
        "the field of view is 50°, not 70°",
        "the camera stands at 9,1,1",
        "the camera looks at 0,5,0",
    ]
    assert len(doubts) == len(beginnings)
    assert all(any(doubt.startswith(words) for doubt in doubts) for words in beginnings)
    modelled = [each.model_copy(update={"at": (0, 1, 0)}) if each.name == "sofa" else each for each in spec.objects]
    outside = spec.model_copy(update={"objects": tuple(modelled)})
    (doubt,) = find_doubts(outside, rest(outside))
    assert doubt.startswith(beginnings[0]), "also where it was modelled"
    assert not find_doubts(outside, Arrangement.of(place={"sofa": (0.9, 0, -0.5)}).apply(outside))
    corner = View(np.float32([9, 1, 1]), np.float32([0, 1, 0]))
    assert len(find_doubts(spec, rest(spec), corner)) == 1


def test_the_jackknife_of_a_mean_is_its_standard_error_and_its_interval_holds_it_as_often_as_it_says() -> None:
    random = np.random.default_rng(1)
    values = random.normal(size=7)
    others = (values.sum() - values) / 6
    found, plain = jackknife(float(values.mean()), others, np.ones(7, np.int64)), Estimate.of(values)
    assert found.standard_error == pytest.approx(plain.standard_error)
    held = 0
    for _ in range(2000):  # parts of unequal weight: means of so many values
        weights = np.array([3, 3, 2, 2, 2])
        means = random.normal(size=5) / np.sqrt(weights)
        total = float(weights @ means)
        without = (total - weights * means) / (12 - weights)
        low, high = jackknife(total / 12, without, weights).interval or (0, 0)
        held += low < 0 < high
    assert held / 2000 == pytest.approx(0.95, abs=0.02)
