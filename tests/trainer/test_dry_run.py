"""What a network and its training would take, as counted, as timed, and as worked out by hand; nothing is written."""

import json
import math
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner, Result

from photonfarm.cli.main import umbrella
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.trainer import dry_run
from photonfarm.trainer.dry_run import DryRun, MadeUpScene, NetworkPart, format_dry_run, rehearse, summarise
from photonfarm.trainer.networks import ARCHITECTURES, predict_image
from photonfarm.trainer.runs.devices import Ranks
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings, make_settings
from photonfarm.trainer.training.learner import Learner


def spec_of(size: int, points: int = 256) -> SceneSpec:
    film = {"width": size, "height": size}
    spec = load_spec("room").model_dump() | {"film": film, "points": points, "photons": {"paths": 64, "depth": 4}}
    return SceneSpec.model_validate(spec)


def settings(**changes: object) -> TrainSettings:
    return make_settings("small", {"width": 4, "points": 256, "device": "cpu", **changes})


def learner_of(scene: MadeUpScene, chosen: TrainSettings) -> Learner:
    return Learner(scene.frame(chosen.network), chosen, Ranks())


def found(size: int = 16, **changes: object) -> DryRun:
    return rehearse(spec_of(size), settings(**changes))


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_every_network_takes_real_steps_on_made_up_samples(architecture: str) -> None:
    scene = MadeUpScene.of(spec_of(16))
    learner = learner_of(scene, settings(architecture=architecture))
    before = [weight.clone() for weight in learner.network.parameters()]
    losses = [learner.step(number, scene.batch(2, settings(architecture=architecture).network)) for number in range(5)]
    assert all(math.isfinite(loss) for loss in losses)
    changed = [not torch.equal(a, b) for a, b in zip(before, learner.network.parameters(), strict=True)]
    assert all(changed)


def test_a_step_has_three_times_the_work_of_an_image() -> None:
    """Backward there are two products for each of forward, but in the first convolution, whose inputs have no gradient.

    A denoiser sees each sample twice.
    """
    for architecture, times in (("cnn", 1), ("denoise_4", 2)):
        run = found(architecture=architecture, batch=4, width=16)
        network = settings(architecture=architecture, width=16).network
        image = 2e9 * sum(part.gmacs for part in summarise(spec_of(16), network))
        assert 2.9 * times < run.sample_flops / image < 3.0 * times
        assert run.step_flops == 4 * run.sample_flops


def test_memory_counts_what_backward_needs_and_not_what_has_the_shape_of_weights() -> None:
    """Of a U-Net of two levels' width 1 each convolution keeps its input once, and the weights are no activations."""
    scene, chosen = MadeUpScene.of(spec_of(16)), settings(architecture="cnn")
    learner = learner_of(scene, chosen)
    _, kept = dry_run.count_work(learner, scene.batch(1, chosen.network))
    inputs = []
    for layer in learner.network.modules():
        if isinstance(layer, torch.nn.Conv2d):
            layer.register_forward_hook(lambda _, given, __: inputs.append(given[0]))
    predict_image(learner.network, scene.batch(1, chosen.network).inputs)
    least = sum({each.data_ptr(): each.untyped_storage().nbytes() for each in inputs}.values())
    assert least <= kept < 2.5 * least


def test_memory_grows_with_pixels_batch_and_precision_and_the_state_is_five_times_the_weights() -> None:
    """Weights, gradients, Adam's two and the average; a count of steps for each tensor."""
    small, large = found(architecture="cnn"), found(32, architecture="cnn")
    wide = [found(32, architecture="cnn", precision=name, width=32) for name in ("bfloat16", "float32")]
    assert large.activation_bytes == pytest.approx(4 * small.activation_bytes, rel=0.02)
    assert 0.5 < wide[0].activation_bytes / wide[1].activation_bytes < 0.6
    assert 20 * small.parameters <= small.state_bytes < 20 * small.parameters + 4 * 100
    assert found(architecture="cnn", average=0).state_bytes == small.state_bytes - 4 * small.parameters
    each = small.activation_bytes + small.sample_bytes
    assert small.memory_bytes == small.batch * each + small.state_bytes


def test_the_time_of_a_whole_batch_is_that_of_the_timed_part_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dry_run, "TIMED_S", 1e-6)
    took = iter([5.0, 2.0, 9.0, 4.0, 3.0])  # first and second of one, whose time is not theirs, and three that count
    monkeypatch.setattr(dry_run, "_time_step", lambda *_: next(took))
    run = found(batch=8, max_steps=100)
    assert (run.timed_samples, run.step_s) == (1, 8 * 4.0)
    assert run.seconds == 100 * 8 * 4.0
    assert "times 8/1" in format_dry_run(run)


def run_verb(*arguments: str) -> Result:
    return CliRunner().invoke(umbrella, ["train", "room", "--device", "cpu", "--set", "width=4", *arguments])


def test_the_verb_writes_nothing_and_says_the_same_as_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    where = ["--dry-run", "--film", "16", "--store", str(tmp_path / "store"), "--run", str(tmp_path / "run")]
    printed, as_json = run_verb(*where), run_verb(*where, "--json")
    assert printed.exit_code == as_json.exit_code == 0, printed.output + as_json.output
    assert list(tmp_path.iterdir()) == []
    assert printed.stderr.splitlines()[-1] == "steps are timed"
    told = json.loads(as_json.stdout)
    assert told["film"] == [16, 16]
    assert f"{told['parameters']:,}" in printed.stdout
    assert told["step_flops"] == told["batch"] * told["sample_flops"]


@pytest.mark.parametrize(
    ("arguments", "exit_code", "said"),
    [
        (("--dry-run", "--summary"), 2, "exclude each other"),
        (("--json",), 2, "--json goes with --dry-run alone"),
        (("--film", "64"), 2, "--film goes with --dry-run alone"),
        (("--dry-run", "--film", "20"), 3, "multiple of 8"),
    ],
)
def test_what_does_not_go_together_is_refused(arguments: tuple[str, ...], exit_code: int, said: str) -> None:
    ended = run_verb(*arguments)
    assert getattr(ended.exception, "exit_code", ended.exit_code) == exit_code
    assert said in ended.output + str(ended.exception)


# ---------------------------------------------------------------------------------------------------------- the summary


def parts(size: int = 64, points: int = 16384, **settings: object) -> dict[str, NetworkPart]:
    return {part.name: part for part in summarise(spec_of(size, points), NetworkSettings(**settings))}


def test_the_papers_network_has_its_published_size_and_work() -> None:
    found = parts(size=256)
    assert found["U-Net"].parameters == 11_734_467  # 11.7 M [method 2]
    assert found["U-Net"].gmacs == pytest.approx(62.1, abs=0.05)  # 62 GMAC at 256²


def test_the_work_of_a_u_net_grows_with_its_pixels_and_with_the_square_of_its_width() -> None:
    by_width = [parts(width=width, architecture="cnn")["U-Net"].gmacs for width in (64, 128)]
    assert by_width[1] == pytest.approx(4 * by_width[0], rel=0.02)
    assert parts(size=128, architecture="cnn")["U-Net"].gmacs == pytest.approx(4 * by_width[0], rel=1e-6)


def test_the_point_branch_is_the_one_of_figure_1() -> None:
    """Each point goes 56 → 64 and two blocks of 64 → 32 twice and 32 → 32; the maximum's half is worked once a cloud.

    Of its 56 numbers the 15 of the position change; 9 others, 32 of the descriptor and the first layer's bias are the
    same in all samples, worked once.
    """
    found = parts()["point branch"]
    assert found.parameters == 16384 * 32 + (56 * 64 + 64) + 2 * (64 * 32 + 32 + 32 * 32 + 32 + 64 * 32)
    first_block = 64 * 32 + 32 * 32 + 64 * 32
    second_block = 32 * 32 + 32 * 32 + 32 * 32
    per_point = 56 * 64 + first_block + second_block
    assert found.gmacs == pytest.approx((16384 * per_point + 2 * 32 * 32) / 1e9, rel=1e-6)


def test_the_denoiser_is_light() -> None:
    whole, light = parts(architecture="cnn")["U-Net"], parts(architecture="denoise_16")["U-Net"]
    assert 0.2 < light.gmacs / whole.gmacs < 0.3
    assert parts(architecture="denoise_16") == parts(architecture="denoise_1")


def test_the_points_set_are_those_counted() -> None:
    found = parts(points=4096, architecture="feature_projection")["point branch"]
    assert found == NetworkPart("point branch", 4096 * 32, 0.0)
    assert parts(points=100)["point branch"].parameters < parts(points=101)["point branch"].parameters


def test_the_table_ends_with_the_sum() -> None:
    lines = dry_run.format_summary(
        [NetworkPart("point branch", 1000, 0.25), NetworkPart("U-Net", 2_000_000, 1.0)]
    ).splitlines()
    assert lines[0].split() == ["part", "parameters", "GMAC"]
    assert lines[2].split() == ["U-Net", "2,000,000", "1.000"]
    assert lines[3].split() == ["total", "2,001,000", "1.250"]
