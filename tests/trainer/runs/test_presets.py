"""What the presets are, and how command line and configuration file choose preset, architecture and precision."""

import re
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner
from pydantic import ValidationError

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SpecError
from photonfarm.trainer import service
from photonfarm.trainer.cli.train_verb import train
from photonfarm.trainer.runs.settings import PRESETS, TrainSettings, make_preset
from photonfarm.trainer.training.losses import paired_loss


def test_the_papers_presets_are_what_the_supplement_states() -> None:
    static, dynamic = make_preset("paper-static"), make_preset("paper-dynamic")
    assert (static.batch, dynamic.batch) == (128, 32)
    for settings in (static, dynamic):
        assert (settings.network.width, settings.network.points) == (64, 16384)
        assert (settings.learning_rate, settings.decay, settings.max_steps) == (5e-4, 0.99, 150_000)
        assert (settings.optimiser, settings.loss, settings.network.precision) == ("adam", "linear", "float32")
        assert settings.network.maxima == "absolute"  # Fig. 1


def test_the_preset_paper_is_the_supplement_to_the_letter() -> None:
    settings = make_preset("paper")
    network = {"architecture": "light_transport", "width": 64, "maxima": "absolute", "octaves": 0, "demodulation": None}
    projection = {"occlusion": "window", "occlusion_tolerance": 1e-3}
    assert settings.network.model_dump(include={*network, *projection}) == network | projection
    optimiser = {"optimiser": "adam", "learning_rate": 5e-4, "schedule": "epochs", "decay": 0.99, "average": 0.0}
    others = {"loss": "linear", "batch": 32, "recover": False}
    assert settings.model_dump(include={*optimiser, *others}) == optimiser | others


def test_values_that_are_not_allowed_are_refused() -> None:
    for named, network in (
        ("architecture", {"architecture": "transformer"}),
        ("descriptor = 0", {"architecture": "feature_projection", "descriptor": 0}),
    ):
        with pytest.raises(ValidationError, match=named):
            make_preset("small", network=network)


def test_the_paired_loss_needs_the_half_that_a_denoiser_is_given() -> None:
    assert make_preset("small", loss="paired").loss == "paired"
    with pytest.raises(ValidationError):
        make_preset("small", network={"architecture": "denoise_16"}, loss="paired")
    image = torch.zeros(1, 2, 2, 3)
    with pytest.raises(ValueError, match="1 half"):
        paired_loss(image, image[:, None])


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch) -> list[TrainSettings]:
    """The settings that training was started with."""
    found: list[TrainSettings] = []

    def run(spec, store, run, preset, changes, redis_url, **_) -> None:
        found.append(service.settle_settings(run, preset, changes))

    monkeypatch.setattr(service, "run", run)
    return found


def test_the_command_line_chooses_preset_architecture_and_precision(chosen: list[TrainSettings]) -> None:
    arguments = ["train", "--preset", "paper-static", "--architecture", "denoise_16", "--precision", "bfloat16"]
    assert CliRunner().invoke(umbrella, [*arguments, "--batch", "7"]).exit_code == 0
    assert CliRunner().invoke(umbrella, ["train"]).exit_code == 0
    asked, plain = chosen
    assert (asked.network.architecture, asked.network.precision) == ("denoise_16", "bfloat16")
    assert (asked.network.points, asked.batch) == (16384, 7)
    assert plain == make_preset("small")


def test_the_configuration_file_chooses_them_as_well(chosen: list[TrainSettings], tmp_path: Path) -> None:
    file = tmp_path / "photonfarm.toml"
    file.write_text('[train]\npreset = "paper-dynamic"\narchitecture = "light_transport_photons"\n')
    found = CliRunner().invoke(umbrella, ["--config", str(file), "train"])
    assert found.exit_code == 0, found.output
    assert chosen == [make_preset("paper-dynamic", network={"architecture": "light_transport_photons"})]


def test_any_setting_is_set_by_its_key_and_its_own_option_comes_first(
    chosen: list[TrainSettings], tmp_path: Path
) -> None:
    pairs = [
        "network.width=8",
        "points=null",
        "occlusion=window",
        "beta1=0.8",
        "epoch_samples=1000",
        "catch_up=5",
        "batch=3",
    ]
    arguments = [word for pair in pairs for word in ("--set", pair)]
    found = CliRunner().invoke(umbrella, ["train", *arguments, "--batch", "7"])
    assert found.exit_code == 0, found.output
    (settings,) = chosen
    network = settings.network
    assert (network.width, network.points, network.occlusion, network.descriptor) == (8, None, "window", 32)
    assert (settings.beta1, settings.epoch_samples, settings.catch_up, settings.batch) == (0.8, 1000, 5, 7)

    file = tmp_path / "photonfarm.toml"
    file.write_text('[train]\nbatch = 7\n[train.set]\nwidth = 8\nocclusion = "window"\nprefetch = 3\n')
    assert CliRunner().invoke(umbrella, ["--config", str(file), "train"]).exit_code == 0
    assert chosen[1] == make_preset("small", network={"width": 8, "occlusion": "window"}, batch=7, prefetch=3)


@pytest.mark.parametrize(
    ("pair", "named"),
    [
        ("widht=8", r"widht: .*nearest: width"),
        ("width=0", r"training: width = 0"),
        ("beta1=much", "beta1 = 'much'"),
        ("gradient_clip=1", "gradient_clip = 1: .*bias it"),
        ('network={"width": 8}', "network: .*width=32"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_with_its_rule_and_the_nearest_key(pair: str, named: str) -> None:
    result = CliRunner().invoke(umbrella, ["train", "--set", pair])
    assert isinstance(result.exception, SpecError)
    assert re.search(named, str(result.exception))
    assert result.exception.exit_code == 3


def test_a_pair_without_a_value_is_wrong_usage() -> None:
    result = CliRunner().invoke(umbrella, ["train", "--set", "width"])
    assert result.exit_code == 2
    assert "KEY=VALUE" in result.output


@pytest.mark.parametrize("flags", [("--check", "--dry-run"), ("--check", "--summary", "--dry-run")])
def test_what_is_done_instead_of_training_is_one_thing(flags: tuple[str, ...], tmp_path: Path) -> None:
    result = CliRunner().invoke(umbrella, ["train", *flags, "--run", str(tmp_path / "run")])
    assert result.exit_code == 2
    assert all(flag in result.output for flag in flags)
    assert list(tmp_path.iterdir()) == []


def test_a_default_that_the_help_states_as_a_number_is_that_of_every_preset() -> None:
    stated = 0
    for option in train.params:
        if found := re.search(r"\[default: ([\d.]+)\]", getattr(option, "help", None) or ""):
            for settings in map(make_preset, PRESETS):
                value = getattr(settings, str(option.name), None)
                assert value == float(found[1]), option.name
                assert option.name != "decay" or settings.schedule == "epochs"
            stated += 1
    assert stated


def test_the_summary_is_printed_and_nothing_else_is_done(tmp_path: Path) -> None:
    arguments = ["train", "room", "--summary", "--store", str(tmp_path / "store"), "--run", str(tmp_path / "run")]
    found = CliRunner().invoke(umbrella, [*arguments, "--architecture", "light_transport_photons"])
    assert found.exit_code == 0, found.output
    head, *table = found.stdout.splitlines()
    assert head == "light_transport_photons for room: 64 × 64 pixels, width 16, 4096 points"
    assert [line.split()[0] for line in table] == [
        "part",
        "point",
        "projection",
        "U-Net",
        "total",
    ]
    assert list(tmp_path.iterdir()) == []


def test_a_summary_needs_a_scene(tmp_path: Path) -> None:
    found = CliRunner().invoke(umbrella, ["train", "--summary", "--store", str(tmp_path / "store")])
    assert found.exit_code != 0
    assert "name the spec" in str(found.exception) + found.output
