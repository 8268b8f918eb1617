"""What the studies on `room` are made of: samples of several spp, errors against noisy references, intervals."""

from __future__ import annotations

import argparse
import math
import operator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic_scene import AnalyticScene, small_spec
from numpy.typing import NDArray
from store_samples import guides

from bench.harness import room_study
from bench.harness.contents import Pool, commit
from bench.harness.network_errors import Errors
from bench.harness.room_study import HELD_OUT, ReferenceViews, Run
from bench.studies.budget_arms import HALF_SPP, ArmSamples, Share, requests
from photonfarm.core.records import F32, Photons, ViewBuffers, Visibility, arrays_of
from photonfarm.plan.hold_out import rows_held_out
from photonfarm.plan.request import Request
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.metrics.image_metrics import t_975
from photonfarm.trainer.runs.settings import make_preset

SIZE, SLOTS = 8, 8
Root = tuple[Path, str]


def pool(spec: SceneSpec) -> Pool:
    rng = np.random.default_rng(1)

    def random(*shape: int) -> Any:
        return rng.random(shape, np.float32)

    halves = [random(2, SIZE, SIZE, 3) for _ in range(7)]
    buffers = [ViewBuffers(random(SIZE, SIZE), *random(2, SIZE, SIZE, 3))]
    position, direction, normal, power = random(4, SLOTS, 3)
    photons = [Photons(position, direction, normal, power, np.zeros(SLOTS, np.int8))]
    seen = [Visibility(random(16) < 0.5, random(SLOTS) < 0.5)]
    return Pool(halves, buffers, [guides(spec, row) for row in range(3)], seen, photons)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Root:
    """Passes of 2 spp: 8 of one view of the first configurations, 2 of two views of more, 1 of one view of the most."""
    store = Store(tmp_path_factory.mktemp("study") / "store", create=True)
    spec = small_spec(film={"width": SIZE, "height": SIZE}, transport={"half_spp": HALF_SPP})
    scene = store.add(spec)
    scene.write_base(*AnalyticScene(spec).base())
    for modifications, views, passes in ((8, 1, 8), (20, 2, 2), (40, 1, 1)):
        request = Request(modifications=modifications, views_per_modification=views, passes=passes)
        scene.plan(request, shard_rows=16)
    for job in scene.missing_jobs():
        commit(scene, job, pool(spec))
    return Path(store.root), spec.scene_id


def configurations(arm: ArmSamples) -> set[bytes]:
    return set(arm.modification_keys(arm.chosen))


@pytest.mark.parametrize("spp", [2, 4, 16])
def test_halves_of_a_cleaner_sample_are_means_over_its_views_first_passes(root: Root, spp: int) -> None:
    arm, source = ArmSamples(*root, Share(spp, 1, 1), 4), SceneReader(*root)
    complete = source.refresh().tolist()
    (key,) = arm.view_keys(arm.chosen[:1])
    passes = [row for row, of in zip(complete, source.view_keys(complete), strict=True) if of == key][: spp // 2]
    (sample,) = arm.read_samples(arm.chosen[:1])

    read = [source.read(row) for row in passes]
    expected = np.mean([one.radiance.astype(np.float64) for one in read], axis=0)
    assert len(read) == spp // 2
    np.testing.assert_allclose(sample.radiance.astype(np.float64), expected, rtol=1e-6)


def test_a_share_is_so_many_views_of_each_configuration_and_samples_of_each_view(root: Root) -> None:
    arm = ArmSamples(*root, Share(2, 2, 2), 5)
    assert len(configurations(arm)) == 5
    assert len(set(arm.view_keys(arm.chosen))) == 10
    assert len(arm.chosen) == len(set(arm.chosen)) == 20
    first, second = (arm.read_samples([row])[0].radiance.copy() for row in arm.chosen[:2])
    assert arm.view_keys(arm.chosen[:1]) == arm.view_keys(arm.chosen[1:2])
    assert np.any(first != second), "two passes of one view"


def test_no_sample_of_an_arm_is_of_a_configuration_that_is_held_out(root: Root) -> None:
    arm = ArmSamples(*root, Share(2, 1, 1), 30)
    assert not any(rows_held_out(arm, arm.chosen, HELD_OUT))
    new = arm.refresh().tolist()
    assert new[:-1] == arm.chosen
    assert rows_held_out(arm, new[-1:], HELD_OUT) == [True], "one for the trainer to look at"
    assert not len(arm.refresh())


def test_samples_that_were_chosen_can_be_read_with_their_guides(root: Root) -> None:
    """What is read together of a sample is what another source reads of it alone."""
    arm, source = ArmSamples(*root, Share(2, 1, 1), 4), SceneReader(*root)
    rows, _ = arm.refresh().tolist(), source.refresh()
    assert rows_held_out(arm, rows, HELD_OUT) == [False] * 4 + [True]
    for row, sample in zip(rows, arm.read_samples(rows), strict=True):
        alone = source.read(row, guides=True)
        for part in ("guides", "buffers", "visibility"):
            read = arrays_of(getattr(sample, part))
            for name, values in arrays_of(getattr(alone, part)).items():
                np.testing.assert_array_equal(read[name], values, err_msg=f"{part} {name} of row {row}")


@pytest.mark.parametrize("number", [0, 1])
def test_configurations_of_cleaner_samples_are_among_those_of_noisier_ones(root: Root, number: int) -> None:
    arms = [ArmSamples(*root, Share(spp, 1, 1), count, (number, 2)) for spp, count in ((2, 16), (4, 8), (16, 3))]
    noisy, medium, clean = map(configurations, arms)

    assert [len(noisy), len(medium), len(clean)] == [16, 8, 3]
    assert clean < medium < noisy


def test_slices_share_no_configuration(root: Root) -> None:
    first, second = (configurations(ArmSamples(*root, Share(4, 1, 1), 8, (number, 2))) for number in (0, 1))
    assert len(first) == len(second) == 8
    assert not first & second


def test_an_arm_of_more_configurations_than_there_are_is_refused(root: Root) -> None:
    with pytest.raises(ValueError, match="64"):
        ArmSamples(*root, Share(16, 1, 1), 64)


def test_what_is_rendered_is_enough_for_every_share_and_slice() -> None:
    shares = {Share(2, 1, 1): 40, Share(8, 4, 1): 5, Share(2, 1, 4): 10}
    asked = requests(shares, slices=2, seed=1)
    assert [(r.views_per_modification, r.passes) for r in asked] == [(4, 4), (1, 4), (1, 1)]
    assert all(r.modifications > 2 * count for r, count in zip(asked, (5, 10, 40), strict=True))


# ---------------------------------------------------------------------------------------------------------- processes


def test_what_fails_in_a_process_is_raised_here() -> None:
    assert room_study.in_processes(math.hypot, [(3.0, 4.0), (5.0, 12.0)], 1, "measured") == [5, 13]
    with pytest.raises(ZeroDivisionError):
        room_study.in_processes(operator.truediv, [(1.0, 0.0)], 1, "measured")


def test_runs_are_trained_in_processes_and_only_those_that_are_not_at_their_end(root: Root, tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    room_study.add_options(parser, "test")
    told = parser.parse_args(["--steps", "2", "--architecture", "cnn"])
    source = partial(ArmSamples, *root, Share(2, 1, 1), 8)
    runs = [Run(source, room_study.settings_of(told, seed), tmp_path, "few") for seed in (0, 1)]
    room_study.train_all(runs[:1], 1)
    assert [run.is_at_its_end() for run in runs] == [True, False]
    (runs[0].folder / "metrics.jsonl").unlink()

    room_study.train_all(runs, 1)
    assert all(run.is_at_its_end() for run in runs)
    assert not (runs[0].folder / "metrics.jsonl").exists(), "left as it was"
    assert runs[1].trained().settings.seed == 1
    assert runs[1].seconds() > 0


def test_a_run_of_a_users_own_network_is_another_once_its_module_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = tmp_path / "mine_of_runs.py"
    module.write_text("first = 1")
    monkeypatch.syspath_prepend(tmp_path)
    network = {"architecture": f"{module.stem}:Own"}
    own, ours = (Run(lambda: None, make_preset("small", network=of), tmp_path, "few") for of in (network, {}))
    before = own.folder, ours.folder
    module.write_text("second = 2")
    assert own.folder != before[0]
    assert ours.folder == before[1]


# ------------------------------------------------------------------------------------------------------------- errors


def noisy_references(noise: float) -> tuple[ReferenceViews, F32]:
    """Sixteen views of halves with normal noise, and the clean images, in the middle of what a display shows."""
    rng = np.random.default_rng(2)
    clean = rng.uniform(0.4, 0.6, (16, 32, 32, 3))
    halves = clean[:, None] + rng.normal(0, noise, (16, 2, 32, 32, 3))
    units = tuple(bytes([number]) * 16 for number in range(16))
    return ReferenceViews(tuple(range(16)), units, halves.astype(np.float32), 64), clean.astype(np.float32)


def shown(image: F32) -> NDArray[np.float64]:
    """What a display shows of values between 0 and 1."""
    values: NDArray[np.float64] = image.astype(np.float64) ** (1 / 2.2)
    return values


def test_noise_is_taken_out_of_shown_errors() -> None:
    references, clean = noisy_references(0.01)
    made = clean + np.float32(0.02)
    true, against_mean = (np.mean((shown(made) - shown(of)) ** 2) for of in (clean, references.mean))

    assert references.shown_errors(made).mean() == pytest.approx(true, rel=0.02)
    assert against_mean > 1.1 * true


def test_errors_of_blocks_are_those_of_their_means() -> None:
    """A checkerboard is an error of each pixel and of no block; an offset is one of both."""
    references, clean = noisy_references(0.001)
    signs = np.indices(clean.shape[1:3]).sum(axis=0) % 2 * 2 - 1
    checkered = shown(clean) + 0.05 * signs[..., None]
    made, brighter = (values.astype(np.float32) ** np.float32(2.2) for values in (checkered, shown(clean) + 0.05))
    assert references.shown_errors(made).mean() == pytest.approx(0.05**2, rel=0.05)
    assert references.shown_errors(made, block=4).mean() == pytest.approx(0, abs=2e-5)
    assert references.shown_errors(brighter, block=4).mean() == pytest.approx(0.05**2, rel=0.05)


def test_what_the_displays_curve_makes_of_noise_stays() -> None:
    references, clean = noisy_references(0.03)
    made, power = clean + np.float32(0.02), 1 / 2.2
    shift = power * (power - 1) / 2 * clean.astype(np.float64) ** (power - 2) * 0.03**2  # δ, to second order
    apart = shown(made) - shown(clean)

    found = references.shown_errors(made)
    expected, reach = np.mean((apart - shift) ** 2), 4 * found.std(ddof=1) / math.sqrt(len(found))  # 4 standard errors
    assert abs(found.mean() - expected) < reach
    assert abs(found.mean() - np.mean(apart**2)) > reach


def test_a_pixels_noise_falls_with_the_root_of_its_samples() -> None:
    references, _ = noisy_references(0.03)
    assert references.noise(32) == pytest.approx(0.03, rel=0.02)  # of one half; 98 304 of its values are known
    assert references.noise(2) == pytest.approx(4 * references.noise(32))


# ---------------------------------------------------------------------------------------------------------- intervals

UNITS = (b"a" * 16, b"a" * 16, b"b" * 16, b"c" * 16)
"""Four views of three configurations."""


def errors(*seeds: list[float]) -> Errors:
    values: NDArray[np.float64] = np.array(seeds)
    return Errors(values, UNITS)


def test_one_seed_has_the_error_over_configurations_alone() -> None:
    found = errors([1.0, 3.0, 4.0, 6.0])  # of configurations: 2, 4, 6
    low, high = found.interval()

    assert found.estimate().mean == pytest.approx(4)
    assert found.estimate().standard_error == pytest.approx(2 / math.sqrt(3))
    assert high - 4 == pytest.approx(4 - low) == pytest.approx(t_975(2) * 2 / math.sqrt(3))


def test_the_variance_of_seeds_is_added_to_that_of_configurations() -> None:
    found = errors([1.0, 3.0, 4.0, 6.0], [3.0, 5.0, 6.0, 8.0])  # means 4 and 6: var / S = 2 / 2
    low, high = found.interval()

    assert found.estimate().mean == pytest.approx(5)
    assert found.estimate().standard_error == pytest.approx(math.sqrt(4 / 3 + 1))
    freedom = (4 / 3 + 1) ** 2 / ((4 / 3) ** 2 / 2 + 1**2 / 1)  # 2.88
    assert high - low == pytest.approx(2 * t_975(int(freedom)) * math.sqrt(4 / 3 + 1))


def test_seeds_alone_leave_as_little_freedom_as_there_are_seeds() -> None:
    low, high = errors([2.0] * 4, [4.0] * 4).interval()
    assert high - low == pytest.approx(2 * t_975(1))


def test_what_all_kinds_of_networks_share_drops_out_of_their_differences() -> None:
    hard = np.array([[1.0, 3.0, 4.0, 6.0], [3.0, 5.0, 6.0, 8.0]])
    less = Errors(hard + 0.5, UNITS).less(Errors(hard, UNITS))
    assert less.interval() == pytest.approx((0.5, 0.5))


def test_one_configuration_has_no_interval() -> None:
    with pytest.raises(ValueError, match="two"):
        Errors(np.ones((2, 1)), UNITS[:1]).interval()
