"""A guided network of one noisy half: how it joins what it is given, its own filter, passes, and OIDN's images."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from analytic_room_samples import AnalyticSource
from numpy.typing import NDArray
from read_batches import batch_of

from photonfarm.core.keys import Key, make_key
from photonfarm.core.processes import Stop
from photonfarm.core.records import F32
from photonfarm.scene.view import View
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import ARCHITECTURES, build
from photonfarm.trainer.networks.guided_denoise import look_at_half
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.networks.light_filter import filter_light
from photonfarm.trainer.predictors import half_filter
from photonfarm.trainer.predictors.half_filter import FOLDER, HalfFilter, settle_filter
from photonfarm.trainer.runs.checkpoint import load
from photonfarm.trainer.runs.devices import Ranks
from photonfarm.trainer.runs.run_folder import CHECKPOINT, METRICS, read_log
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings, make_preset
from photonfarm.trainer.training.learner import Learner
from photonfarm.trainer.training.loop import Hooks, train

NAME = "guided_denoise"
NEEDS = ARCHITECTURES[NAME].needs
PASSES = 4


def network(source: AnalyticSource, **settings: Any) -> torch.nn.Module:
    chosen = NetworkSettings(**{"width": 4, "architecture": NAME, **settings})
    return build(chosen, SceneFrame.of(source.spec, *source.base(), chosen), 0)


def settings_of(**changes: Any) -> TrainSettings:
    return make_preset("small", network={"architecture": NAME, "width": 4, "points": 256}, **changes)


class PassesSource(AnalyticSource):
    """Samples of which every `PASSES` are noisy passes of one view."""

    def view(self, row: int) -> View:
        return super().view(row - row % PASSES)

    def modification(self, row: int) -> Any:
        return super().modification(row - row % PASSES)

    def sample_keys(self, rows: Sequence[int]) -> list[Key]:
        return [make_key(key, row) for key, row in zip(super().sample_keys(rows), rows, strict=True)]

    def earlier_passes(self, row: int) -> NDArray[np.int64]:
        return np.arange(row - row % PASSES, row)


# ------------------------------------------------------------------------------------------------- the joined image


def test_it_starts_from_the_filtered_half_and_the_known_light_and_goes_on_to_the_half_as_its_noise_falls(
    make_source,
) -> None:
    source = make_source(1)
    made, inputs = network(source, filter="oidn-fast"), batch_of(source, (0,), NEEDS).inputs
    torch.nn.init.zeros_(made.image_synthesis.out.weight)
    torch.nn.init.zeros_(made.image_synthesis.out.bias)
    known, filtered = made.known(inputs, made.further(inputs)), inputs.noisy.colour + 0.5
    made.shares[:2] = -torch.inf  # what our own filter makes, which depends on the variance
    images = {}
    for variance in (1e9, 1e-4, 0.0):
        how = {"passes": torch.full((1,), 2.0), "variance": torch.full_like(inputs.depth, variance)}
        told = replace(inputs.noisy, filtered=filtered, **how)
        images[variance] = made(replace(inputs, noisy=told))
    wanted = (
        filtered + 0.1192 * (known - filtered) / 2**0.5
    )  # what is added to the filtered half, over the passes' root
    torch.testing.assert_close(images[1e9], wanted, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(images[0.0], inputs.noisy.colour)
    off = [float((image - inputs.noisy.colour).detach().abs().mean()) for image in images.values()]
    assert off[0] > 100 * off[1] > 0, "further from the half than noise explains: no error of the guess was learned"


def test_what_it_learned_for_one_pass_fades_by_the_root_of_their_number(make_source) -> None:
    """By 25 passes the coarse filter's share is a fifth, and where nothing reflects four fifths are the half's."""
    source = make_source(1)
    made, inputs = network(source, filter="own"), batch_of(source, (0,), NEEDS).inputs
    torch.nn.init.zeros_(made.image_synthesis.out.weight)
    torch.nn.init.zeros_(made.image_synthesis.out.bias)
    guides, never = inputs.guides, torch.full_like(inputs.depth, 1e9)
    for image in (inputs.albedo, guides.specular, guides.throughput):
        image.zero_()
    noisy = replace(inputs.noisy, variance=never)
    made.shares[:] = torch.tensor([-torch.inf, 0.0])

    def image(passes: float) -> torch.Tensor:
        told = replace(inputs, noisy=replace(noisy, passes=torch.full((1,), passes)))
        return made(told).detach()

    known = made.known(inputs, made.further(inputs))
    half = look_at_half(inputs, replace(noisy, passes=torch.full((1,), 25.0)), made.measure_places(inputs))
    coarse = half.filtered[..., 1]
    torch.testing.assert_close(image(1.0), known)
    torch.testing.assert_close(image(25.0), known + 0.8 * (1 - 0.1192 / 5) * (coarse - known), rtol=1e-3, atol=1e-4)
    assert torch.equal(made(replace(inputs, noisy=replace(noisy, variance=None))), image(1.0))
    made.shares[:] = 0.0
    mixed = known + 0.8 * (1 - 0.1192 / 5) * ((5 * half.filtered[..., 0] + coarse) / 6 - known)
    torch.testing.assert_close(image(25.0), mixed, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("passes", [4.0, 25.0])
def test_by_a_setting_known_direct_light_is_filtered_in_its_images_and_less_as_passes_come(
    make_source, passes: float
) -> None:
    """A network that has learned nothing, and a half that is too noisy to be taken."""
    source = make_source(1)
    inputs = batch_of(source, (0,), NEEDS).inputs
    told = {"passes": torch.full((1,), passes), "variance": torch.full_like(inputs.depth, 1e9)}
    inputs = replace(inputs, noisy=replace(inputs.noisy, **told))
    images = []
    for filters in (False, True):
        made = network(source, filter="own", filter_direct=filters)
        torch.nn.init.zeros_(made.image_synthesis.out.weight)
        torch.nn.init.zeros_(made.image_synthesis.out.bias)
        images.append(made(inputs).detach())
    quieter = made.share_direct(made.filter_direct(inputs)[1], torch.zeros(1, 1, 1, 3))
    assert quieter.abs().max() > 0.01
    of_known = 0.1192 / passes**0.5  # whose share of the image is not that of the filtered half
    added = (of_known + (1 - of_known) / passes**0.5) * quieter
    torch.testing.assert_close(images[1] - images[0], added, rtol=1e-3, atol=1e-4)


def test_its_image_depends_on_half_a_and_never_on_half_b(make_source) -> None:
    source = make_source(1)
    made, sample = network(source), source.read(0)
    source.read = lambda _: sample

    def image() -> torch.Tensor:
        with torch.no_grad():
            return made(batch_of(source, (0,), NEEDS).inputs)

    before = image()
    sample.radiance[1] *= 100
    assert torch.equal(image(), before)
    sample.radiance[0, 4, 4] += 1
    assert not torch.equal(image(), before)


def test_what_is_told_of_a_half_has_no_gradient_and_is_finite_for_black_images(make_source) -> None:
    source = make_source(2)
    batch = batch_of(source, (0, 1), NEEDS)
    batch.inputs.noisy.colour.zero_()
    made = network(source)
    made(batch.inputs).sum().backward()
    assert all(torch.isfinite(weight.grad).all() for weight in made.parameters())


# ---------------------------------------------------------------------------------------------------- its own filter


def images_of(size: int = 32) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Textured reflectance, normals and places of two walls that meet in the middle, and clean light on them."""
    generator = torch.Generator().manual_seed(0)
    reflects = 0.2 + torch.rand(1, size, size, 3, generator=generator)
    left = (torch.arange(size) < size // 2)[None, None, :, None]
    normal = torch.where(left, torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1])).expand(1, size, size, 3)
    along = torch.arange(size) / size - 0.5
    across, down = along.expand(size, size), along[:, None].expand(size, size)
    places = torch.stack([across.clamp(min=0), down, -across.clamp(max=0)], dim=-1)[None]
    return reflects, normal.contiguous(), places, torch.where(left, 1.0, 0.1)


def test_the_filter_keeps_textures_and_edges_and_takes_most_of_the_noise() -> None:
    reflects, normal, places, light = images_of()
    clean = reflects * light
    none = torch.full((1, 32, 32, 1), 1e-6)
    for image in filter_light(clean, reflects, none, normal, places):
        torch.testing.assert_close(image, clean, rtol=1e-4, atol=1e-5)
    torch.manual_seed(1)
    noisy = clean * torch.distributions.Gamma(4.0, 4.0).sample(clean.shape[:3])[..., None]
    spread = ((clean.mean(dim=-1, keepdim=True)) ** 2 / 4).contiguous()
    images = noisy, *filter_light(noisy, reflects, spread, normal, places)
    before, fine, coarse = (float(((image - clean) / clean).square().mean()) for image in images)
    assert coarse < 0.2 * before
    assert coarse < 0.7 * fine < 0.7 * before
    assert float(images[2].mean() / clean.mean()) == pytest.approx(1, abs=0.08)  # dark ones agree more often


# -------------------------------------------------------------------------------------------------------------- passes


def test_half_a_is_the_mean_of_some_passes_and_its_noise_is_what_they_differ_by(make_source) -> None:
    spec = make_source(1).spec
    source, counts = PassesSource(spec, 96), np.zeros(PASSES, int)
    halves: list[F32] = [source.read(row).radiance for row in range(96)]
    for row in range(96):
        batch = batch_of(source, (row,), NEEDS)
        first = row - row % PASSES
        means = {n: np.mean(halves[row + 1 - n : row + 1], axis=0) for n in range(1, row - first + 2)}
        (count,) = [n for n, mean in means.items() if np.allclose(batch.target[0].numpy(), mean, atol=1e-5)]
        counts[count - 1] += 1
        for half, told in enumerate((batch.inputs.noisy, batch.other)):
            torch.testing.assert_close(told.colour, batch.target[:, half])
            passes = np.stack(halves[row + 1 - count : row + 1])[:, half].mean(axis=-1)
            wanted = passes.var(axis=0, ddof=1) / count if count > 1 else np.zeros(passes.shape[1:])
            assert told.passes.tolist() == [count]
            np.testing.assert_allclose(told.variance[0].numpy(), wanted, rtol=1e-3, atol=1e-5)
    expected = 24 * np.array([1 + 1 / 2 + 1 / 3 + 1 / 4, 1 / 2 + 1 / 3 + 1 / 4, 1 / 3 + 1 / 4, 1 / 4])
    assert (np.abs(counts - expected) < 4 * np.sqrt(expected)).all()
    assert batch_of(source, (3,), ARCHITECTURES["denoise_1"].needs).inputs.noisy.variance is None


# ------------------------------------------------------------------------------------------------------------ training


def test_it_ends_after_so_many_rounds_with_a_rate_that_has_fallen_and_says_how_many(make_source, run) -> None:
    settings = settings_of(batch=2, rounds=3, hold_out=0.25, validate_every=4, poll_seconds=0.01)
    outcome = train(make_source(16), settings, run)
    log = read_log(run / METRICS)
    training = log[-1]["samples"] - next(record["held_out"] for record in log if record["kind"] == "validation")
    assert (outcome.reason, outcome.step) == ("rounds", 3 * training // 2)
    last = [record for record in log if record["kind"] == "validation"][-1]
    assert last["rounds"] == pytest.approx(3, abs=0.1)
    learner = Learner(SceneFrame.of((s := make_source(1)).spec, *s.base(), settings.network), settings, Ranks())
    learner.last_step = outcome.step
    assert learner.rate(outcome.step) == pytest.approx(0, abs=1e-9)
    assert learner.rate(outcome.step // 2) > 0.3 * settings.learning_rate


class PlansSource(AnalyticSource):
    """Samples of plans of 16 each."""

    @property
    def plan_requests(self) -> list[dict[str, Any]]:
        return [{"samples": 16}] * (self.planned // 16)


def test_a_run_whose_rounds_are_over_goes_on_with_further_samples(make_source, run) -> None:
    spec = make_source(1).spec
    settings = settings_of(batch=2, rounds=1, hold_out=0.25, poll_seconds=0.01)
    ends = [train(PlansSource(spec, samples), settings, run) for samples in (16, 32, 32)]
    assert [end.reason for end in ends] == ["rounds"] * 3
    assert ends[0].step < ends[1].step == ends[2].step


def test_a_run_that_was_stopped_goes_on_to_the_same_state(make_source, tmp_path) -> None:
    """With passes averaged, and with the schedule that its rounds end."""
    spec = make_source(1).spec
    settings = settings_of(batch=2, rounds=1, hold_out=0.25, validate_every=6, poll_seconds=0.01)
    stop = Stop()
    stopping = Hooks(stop=stop, on_draws=lambda draws, _: stop.set() if draws == 4 else None)
    for name, hooks in (("whole", [Hooks()]), ("parts", [stopping, Hooks()])):
        ends = [train(PassesSource(spec, 16), settings, tmp_path / name, each) for each in hooks]
        assert ends[-1].reason == "rounds"
    assert ends[0].step == 2 < ends[1].step
    whole, parts = (load(tmp_path / name / CHECKPOINT) for name in ("whole", "parts"))
    assert whole["step"] == parts["step"]
    assert torch.equal(whole["excess"], parts["excess"])
    for name, weight in whole["network"].items():
        assert torch.equal(weight, parts["network"][name])


def test_a_loss_below_that_of_clean_images_is_told_from_one_above(make_source, monkeypatch) -> None:
    """A network that makes the target by heart, one that makes the clean image, and one that makes its input."""
    source = make_source(24, size=16)
    batch = batch_of(source, tuple(range(24)), NEEDS)
    clean = torch.from_numpy(np.stack([source.clean(row) for row in range(24)]))
    settings = settings_of(loss="linear")
    frame, found = SceneFrame.of(source.spec, *source.base(), settings.network), []
    target = batch.for_training().target[:, 0]
    for image in (target, torch.cat([clean, clean]), batch.for_training().inputs.noisy.colour):
        learner = Learner(frame, settings, Ranks())
        learner._note_excess(0, image, batch.for_training())
        found.append(float(learner.excess))
    floor = float((batch.target[:, 0] - batch.target[:, 1]).square().mean()) / 2
    assert found[0] == pytest.approx(-floor, rel=1e-4)
    assert abs(found[1]) < 0.1 * floor
    assert found[2] == pytest.approx(floor, rel=1e-4)


# ---------------------------------------------------------------------------------------------- OIDN's filtered halves


def test_oidn_s_images_come_with_the_batch_and_are_kept_beside_the_run(make_source, tmp_path) -> None:
    pytest.importorskip("mitsuba_oidn", reason="the extra `oidn` is not installed")
    source, settings = make_source(2), settle_filter(settings_of())
    assert settings.network.filter == "oidn"
    batch = batch_of(source, (0, 1), NEEDS)
    with pytest.raises(ValueError, match="inputs"):
        network(source, filter="oidn-fast")(batch.inputs)

    def filtered(given: TrainingBatch) -> TrainingBatch:
        return HalfFilter(settings, run=tmp_path).filter_both(given)

    one, again = filtered(batch), filtered(batch)
    assert len(list((tmp_path / FOLDER).glob("oidn-*/*.npy"))) == 4
    assert torch.equal(one.inputs.noisy.filtered, again.inputs.noisy.filtered)
    assert torch.equal(one.other.filtered, again.other.filtered)
    poked = replace(batch, other=replace(batch.other, colour=batch.other.colour + 1))
    fresh = filtered(poked)  # which nothing kept of another half stands for
    assert len(list((tmp_path / FOLDER).glob("oidn-*/*.npy"))) == 6
    assert torch.equal(fresh.inputs.noisy.filtered, one.inputs.noisy.filtered)
    assert not torch.equal(fresh.other.filtered, one.other.filtered)
    at_prediction = HalfFilter(settings)(batch.inputs)
    assert torch.equal(at_prediction.noisy.filtered, one.inputs.noisy.filtered)
    assert torch.isfinite(network(source, filter="oidn-fast")(at_prediction)).all()


def test_a_run_goes_on_by_the_filter_that_it_was_begun_with(make_source, run, monkeypatch) -> None:
    settings = settings_of(batch=2, hold_out=0.25, poll_seconds=0.01)
    monkeypatch.setattr(half_filter, "find_spec", lambda _: None)
    train(make_source(16), settings.model_copy(update={"max_steps": 1}), run)
    monkeypatch.setattr(half_filter, "find_spec", lambda _: "installed since")
    assert settle_filter(settings).network.filter == "oidn"
    train(make_source(16), settings.model_copy(update={"max_steps": 2}), run)
    assert load(run / CHECKPOINT)["settings"]["network"]["filter"] == "own"


def test_noise_is_found_from_neighbours_where_there_is_one_pass(make_source) -> None:
    """Relative noise of ±50 % on a smooth wall, within a fifth."""
    source = make_source(1, size=32)
    inputs = batch_of(source, (0,), NEEDS).inputs
    guides = inputs.guides
    for image in (guides.direct, guides.gloss, guides.emission, guides.specular, guides.throughput):
        image.zero_()
    inputs.albedo.fill_(0.5)
    noise = 1 + 0.5 * torch.randn(1, 32, 32, 1, generator=torch.Generator().manual_seed(0))
    noisy = replace(inputs.noisy, colour=noise.expand(-1, -1, -1, 3))
    half = look_at_half(inputs, noisy, torch.zeros(1, 32, 32, 3))
    assert float(half.noise.mean()) == pytest.approx(0.25 / 1.01, rel=0.25)
