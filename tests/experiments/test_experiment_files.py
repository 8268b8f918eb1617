"""The experiments' files: their names, networks, scenes and sizes."""

import json
import os
from itertools import product
from typing import get_args

import pytest

from experiments import experiment
from experiments.experiment import FREE_SPACE, Experiment, SizeName, list_names
from photonfarm.core.errors import SpecError
from photonfarm.scene.spec import Emitters
from photonfarm.scene.spec_loading import SCENES_VARIABLE

ROOMS = ("dining-room", "living-room", "living-room-2", "veach-ajar")
EXPECTED = [*(f"{lights}-{room}" for lights in ("fixed", "movable") for room in ROOMS)]
EXPECTED += ["night-dining-room", "night-living-room", "night-living-room-2"]
EXPECTED += ["static-ablation", "static-bathroom", "static-kitchen", "vanishing-living-room-2"]


def test_the_experiments_are_all_there_and_others_are_refused() -> None:
    assert list_names() == EXPECTED == list(json.loads((experiment.HERE / FREE_SPACE).read_text()))
    with pytest.raises(SpecError, match="fixed-dining-room"):
        Experiment.load("kitchen-sink", "small")


@pytest.mark.parametrize(("name", "size"), [*product(EXPECTED, get_args(SizeName))])
def test_an_experiment_s_file_is_right_in_both_sizes(name: str, size: SizeName) -> None:
    found = Experiment.load(name, size)
    runs = {run.name: run.train for run in found.trained()}
    assert {"light_transport", "cnn"} <= set(runs)
    losses = {settings["loss"] for settings in runs.values() if not settings["architecture"].startswith("denoise")}
    assert len(losses) == 1, "networks of one table are trained alike"


@pytest.mark.skipif(SCENES_VARIABLE not in os.environ, reason=f"{SCENES_VARIABLE} names no folder with the rooms")
@pytest.mark.parametrize("name", EXPECTED)
def test_an_experiment_s_scene_is_what_its_name_says(name: str) -> None:
    spec, paper = (Experiment.load(name, size).spec() for size in ("small", "paper"))
    assert spec.credits is not None
    assert spec.view.free_space is not None
    assert bool(spec.lights) == name.startswith(("movable", "night", "vanishing"))
    assert (spec.emitters == Emitters(all=0)) == name.startswith(("night", "vanishing"))
    assert bool(spec.objects) != name.startswith("static")
    size = 128 if name == "static-ablation" else 256
    assert (paper.film.width, paper.film.height) == (size, size)


def test_the_size_card_is_for_ten_minutes_a_network_and_has_the_most_telling_first() -> None:
    found = Experiment.load("fixed-veach-ajar", "card")
    assert [run.name for run in found.trained()[:2]] == ["guided_transport", "denoise_1"]
    assert all(run.train["max_seconds"] == 600 for run in found.trained())


def test_some_networks_are_trained_for_longer_too_and_in_three_rooms_from_three_seeds() -> None:
    found = {name: {run.name: run for run in Experiment.load(name, "small").trained()} for name in EXPECTED}
    for name, runs in found.items():
        long = [run for run in runs if run.endswith("-4000")]
        assert bool(long) == (name != "static-ablation")
        for run in long:
            short = runs[run.removesuffix("-4000")]
            assert runs[run].train == {**short.train, "max_steps": 4000}
            assert runs[run].further == short.further
    assert {name for name, runs in found.items() if runs["cnn"].further} == {
        "fixed-living-room",
        "fixed-veach-ajar",
        "night-living-room-2",
        "static-ablation",
    }
    chosen = Experiment.load("fixed-veach-ajar", "small").only(["cnn-4000", "guided"])
    assert [run.name for run in chosen.trained()] == ["cnn-4000", "guided"]


def test_a_look_has_the_networks_that_are_named_from_the_first_seed() -> None:
    whole = Experiment.load("fixed-veach-ajar", "small")
    found = whole.only(["denoise_1_reflectance", "guided"])
    assert [run.name for run in found.trained()] == ["guided", "denoise_1_reflectance"]
    settings = {run.name: run.train for run in whole.trained()}
    assert all(run.train == settings[run.name] and not run.further for run in found.trained())
    assert not found.again()
    with pytest.raises(SpecError, match="no network of it is named gided"):
        whole.only(["guided", "gided"])


def test_reports_have_features_in_the_rooms_of_the_paper_s_tables_but_for_a_look() -> None:
    parts = {
        name: Experiment.load(name, "small") for name in ("fixed-veach-ajar", "night-living-room", "static-kitchen")
    }
    assert [each.has_features for each in parts.values()] == [True, True, False]
    assert not parts["fixed-veach-ajar"].only(["cnn"]).has_features
