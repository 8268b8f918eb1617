"""Devices by their names, and cards as a driver lists them: here a library of the test's own, as most machines have no
driver. On a machine with one, it is asked as well.
"""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import nvidia_driver
import pytest
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import BackendError
from photonfarm.farm import devices
from photonfarm.farm.devices import Card, Cards, cards_here, visible_device, worker_devices

Driver = Callable[..., Cards]
TWO = Cards((Card(0, "Test Card A", "8.9", 8 << 30), Card(1, "Test Card B", "8.9", 8 << 30)), "", 1208)


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A library with the functions of a driver that are used."""
    return nvidia_driver.made(tmp_path_factory.mktemp("driver"))


@pytest.fixture
def driver(library: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Driver]:
    """Function that returns the cards of this machine as the library lists them; its options are variables of it."""
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", str(library))
    monkeypatch.setenv("DRJIT_LIBOPTIX_PATH", str(library))

    def listed(**variables: str) -> Cards:
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        cards_here.cache_clear()
        return cards_here()

    yield listed
    cards_here.cache_clear()


def test_the_cards_of_a_driver_are_listed_by_another_process(driver: Driver) -> None:
    found = driver()
    assert (found.cards, found.cuda, found.trouble) == (TWO.cards, TWO.cuda, "")


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        ({"TEST_INIT": "100"}, "no CUDA-capable device"),
        ({"TEST_INIT": "3"}, "error 3"),
        ({"TEST_CARDS": "0"}, "CUDA_VISIBLE_DEVICES"),
        ({"TEST_CUDA": "12010"}, "R535"),
        ({"TEST_CUDA": "12070"}, "R570"),
        ({"DRJIT_LIBOPTIX_PATH": "/nowhere/libnvoptix.so.1"}, "NVIDIA_DRIVER_CAPABILITIES must hold graphics"),
        ({"DRJIT_LIBCUDA_PATH": "/nowhere/libcuda.so.1"}, "there is no NVIDIA driver"),
    ],
)
def test_a_driver_that_cannot_render_is_told_why_and_auto_is_the_processor(
    driver: Driver, variables: dict[str, str], said: str
) -> None:
    found = driver(**variables)
    assert said in found.trouble
    assert found.card("auto") is found.card("cpu") is None
    assert worker_devices("auto", found) == ("cpu",)
    with pytest.raises(BackendError, match="--device cpu"):
        found.card("cuda")


def test_names_stand_for_cards() -> None:
    assert TWO.card("cpu") is None
    assert TWO.card("auto") == TWO.card("cuda") == TWO.card("cuda:0") == TWO.cards[0]
    assert TWO.card("cuda:1") == TWO.cards[1]
    for wrong in ("cuda:2", "gpu", "cuda:", "cuda:-1", ""):
        with pytest.raises(BackendError):
            TWO.card(wrong)


def test_workers_take_all_cards_in_turn_unless_one_is_named() -> None:
    assert worker_devices("auto", TWO) == worker_devices("cuda", TWO) == ("cuda:0", "cuda:1")
    assert worker_devices("cuda:1", TWO) == ("cuda:1",)
    assert worker_devices("cpu", TWO) == ("cpu",)


@pytest.mark.parametrize(("visible", "shown"), [(None, "1"), ("", "1"), ("3,5", "5"), ("GPU-a, GPU-b", "GPU-b")])
def test_a_card_is_shown_alone_among_those_that_are_visible(
    visible: str | None, shown: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(devices.VISIBLE_VARIABLE, raising=False)
    if visible is not None:
        monkeypatch.setenv(devices.VISIBLE_VARIABLE, visible)
    assert visible_device(TWO.cards[1]) == shown


def test_a_device_that_is_not_there_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not cards_here().trouble:
        pytest.skip("this machine has a card")
    monkeypatch.setenv("PHOTONFARM_DEVICE", "cpu")  # which verbs write to, and the test's end restores
    monkeypatch.chdir(tmp_path)
    for verb in (["work", "--until-complete"], ["up", "cornell", "--modifications", "1"], ["doctor"]):
        wrong = CliRunner().invoke(umbrella, [*verb, "--device", "gpu"])
        assert (wrong.exit_code, os.environ["PHOTONFARM_DEVICE"]) == (2, "cpu")
    for verb in (["work", "--until-complete"], ["up", "cornell", "--modifications", "1", "--train-steps", "0"]):
        refused = CliRunner().invoke(umbrella, [*verb, "--device", "cuda:1"])
        assert isinstance(refused.exception, BackendError)
        assert refused.exception.exit_code == 6
    assert not list(tmp_path.iterdir())


def test_this_machine_says_what_cards_it_has_or_why_it_has_none() -> None:
    cards_here.cache_clear()
    found = cards_here()
    assert bool(found.trouble) or all(card.memory_bytes > 1 << 28 and "." in card.capability for card in found.cards)
    assert found.cards or found.trouble
