"""What a training would take, as counted, as timed, and as worked out by hand; and that nothing is written."""

import json
import math
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner, Result

from photonfarm.cli.main import umbrella
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.trainer.dry_run import dry_run
from photonfarm.trainer.dry_run.dry_run import DryRun, describe, format_dry_run, rehearse
from photonfarm.trainer.dry_run.made_up import LiveMemory, MadeUpScene
from photonfarm.trainer.networks import ARCHITECTURES, predict_image
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.networks.summary import summarise
from photonfarm.trainer.runs.settings import TrainSettings, make_settings
from photonfarm.trainer.training.learner import Learner


def spec_of(size: int) -> SceneSpec:
    film = {"width": size, "height": size}
    spec = load_spec("room").model_dump() | {"film": film, "points": 256, "photons": {"paths": 64, "depth": 4}}
    return SceneSpec.model_validate(spec)


def settings(**changes: object) -> TrainSettings:
    return make_settings("small", {"width": 4, "points": 256, "device": "cpu", **changes})


def found(size: int = 16, **changes: object) -> DryRun:
    return rehearse(spec_of(size), settings(**changes))


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_every_network_takes_real_steps_on_made_up_samples(architecture: str) -> None:
    scene = MadeUpScene.of(spec_of(16))
    learner = Learner(scene, settings(architecture=architecture))
    before = [weight.clone() for weight in learner.network.parameters()]
    losses = [learner.step(number, scene.batch(2, settings(architecture=architecture))) for number in range(5)]
    assert all(math.isfinite(loss) for loss in losses)
    changed = [not torch.equal(a, b) for a, b in zip(before, learner.network.parameters(), strict=True)]
    assert all(changed)


def test_points_of_the_made_up_scene_are_seen_in_its_views() -> None:
    scene, chosen = MadeUpScene.of(spec_of(64)), settings(architecture="feature_projection")
    network = Learner(scene, chosen).network
    (channels,) = network.further(scene.batch(3, chosen).inputs)
    covered = (channels.abs().sum(dim=-1) > 0).flatten(1).sum(dim=1)
    assert isinstance(network, Network)
    assert (covered > 0.05 * 256).all()
    assert predict_image(network, scene.batch(3, chosen).inputs).isfinite().all()


def test_a_step_has_three_times_the_work_of_an_image() -> None:
    """Backward there are two products for each of forward, but in the first convolution, whose inputs have no gradient.

    A denoiser sees each sample twice.
    """
    for architecture, times in (("cnn", 1), ("denoise_4", 2)):
        run = found(architecture=architecture, batch=4, width=16)
        network = settings(architecture=architecture, width=16).network
        image = 2e9 * sum(part.gmacs for part in summarise(spec_of(16), network))
        assert 2.9 * times < run.work.flops / image < 3.0 * times
        assert run.step_flops == 4 * run.work.flops


def test_memory_counts_what_lives_at_once_and_not_what_is_left_out() -> None:
    given = torch.zeros(1000)
    with LiveMemory(but_for=[torch.Size([7])]) as memory:
        one = given + 1  # 4000 bytes
        assert one.view(10, 100).sum() == 1000  # 4 more, freed at once
        two = torch.cat([one, one])  # 8000
        del one
        three = two.double()  # 16 000 while two is there
        del two
        torch.zeros(7).add_(1)
        assert memory.peak_bytes == 24_000
        assert three.sum() == 2000
    assert 24_000 <= memory.peak_bytes < 24_100


def test_memory_grows_with_pixels_batch_and_precision_and_the_state_is_five_times_the_weights() -> None:
    """Weights, gradients, Adam's two and the average; a count of steps for each tensor."""
    small, large = found(architecture="cnn"), found(32, architecture="cnn")
    wide = [found(32, architecture="cnn", precision=name, width=32).work for name in ("bfloat16", "float32")]
    assert large.work.activation_bytes == pytest.approx(4 * small.work.activation_bytes, rel=0.02)
    assert 0.5 < wide[0].activation_bytes / wide[1].activation_bytes < 0.6
    assert 20 * small.parameters <= small.state_bytes < 20 * small.parameters + 4 * 100
    assert found(architecture="cnn", average=0).state_bytes == small.state_bytes - 4 * small.parameters
    each = small.work.activation_bytes + small.work.sample_bytes
    assert small.memory_bytes == small.batch * each + small.state_bytes


def test_the_time_of_a_whole_batch_is_that_of_the_timed_part_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dry_run, "SECONDS", 1e-6)
    took = iter([5.0, 2.0, 9.0, 4.0, 3.0])  # first and second of one, whose time is not theirs, and three that count
    monkeypatch.setattr(dry_run, "_time_step", lambda *_: next(took))
    run = found(batch=8, max_steps=100)
    assert (run.timed.samples, run.timed.steps, run.timed.step_s) == (1, 3, 8 * 4.0)
    assert run.seconds == 100 * 8 * 4.0
    assert "times 8/1" in format_dry_run(run)


def test_a_batch_that_fits_is_timed_whole() -> None:
    run = found(batch=3)
    assert run.timed.samples == 3
    assert 0 < run.timed.step_s < dry_run.SECONDS
    assert run.timed.peak_bytes is None


def test_the_paper_takes_the_work_of_its_convolutions() -> None:
    """62.1 GMAC forward at 256² [method 2], three times that in a step: of 150 000 steps of 32 are 1.8 · 10¹⁸."""
    spec = load_spec("room").model_copy(update={"film": load_spec("room").film.model_copy(update={"width": 64})})
    scene, paper = MadeUpScene.of(spec), make_settings("paper", {"device": "cpu"})
    work = dry_run.count_work(Learner(scene, paper), scene.batch(1, paper))
    assert 16 * work.flops == pytest.approx(3 * 2 * 62.1e9, rel=0.03)


def run_verb(*arguments: str) -> Result:
    return CliRunner().invoke(umbrella, ["train", "room", "--device", "cpu", "--set", "width=4", *arguments])


def test_the_verb_writes_nothing_and_says_the_same_as_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    where = ["--dry-run", "--film", "16", "--store", str(tmp_path / "store"), "--run", str(tmp_path / "run")]
    printed, as_json = run_verb(*where), run_verb(*where, "--json")
    assert printed.exit_code == as_json.exit_code == 0, printed.output + as_json.output
    assert list(tmp_path.iterdir()) == []
    told = json.loads(as_json.stdout)
    assert told["film"] == [16, 16]
    assert f"{told['parameters']:,}" in printed.stdout
    assert told["step_flops"] == told["batch"] * told["work"]["flops"]


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


def test_a_document_is_json(tmp_path: Path) -> None:
    assert json.loads(json.dumps(describe(found())))["work"]["flops"] > 0
