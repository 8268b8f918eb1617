"""`photonfarm evaluate` on a store: what is measured, on which samples, against which references."""

import json
import re
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from PIL import Image

from photonfarm.cli.main import main, umbrella
from photonfarm.core.errors import IncompleteError, SpecError, StoreError
from photonfarm.core.pictures import display
from photonfarm.plan.hold_out import are_held_out
from photonfarm.plan.request import Request
from photonfarm.scene.modification import sample_modification
from photonfarm.store import SceneReader, SceneStore
from photonfarm.store.read.merge import MergedView
from photonfarm.trainer.compare.evaluate import compare
from photonfarm.trainer.compare.evaluation_page import (
    COMPARISON,
    EVALUATION,
    draw_comparison,
    format_evaluation,
    list_notes,
)
from photonfarm.trainer.compare.evaluation_samples import References
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.metrics.features import find_weights
from photonfarm.trainer.metrics.image_metrics import metric_space, mse
from photonfarm.trainer.networks.inputs import Needs
from photonfarm.trainer.predictors.evaluation import (
    TIMED_ROUNDS,
    WARM_ROUNDS,
    DevicePredictor,
    read_batches,
    read_in_turn,
    time_by_turns,
)
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs.run_folder import METRICS, read_log
from photonfarm.trainer.training.loop import train

QUICK = {"without_inception": True}


def test_training_measures_the_views_that_evaluate_does_each_by_its_first_pass(measured, trained) -> None:
    run = trained()
    last = [record for record in read_log(run.folder / METRICS) if record["kind"] == "validation"][-1]
    found = compare(measured.store, [run])
    assert last["held_out"] == found.samples == len(measured.held_out()) // 2
    assert last["error"] == pytest.approx(found.rows[0].held_out.error.mean, rel=1e-6)


def test_without_its_package_a_denoiser_says_what_to_install(measured, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    asked = ["--store", str(measured.store), "--run", str(measured.runs[0]), "--denoiser", "oidn-fast"]
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", *asked])
    assert ended.value.code == click.UsageError.exit_code
    assert "'.[oidn]'" in capsys.readouterr().err


def test_a_network_is_measured_once_on_each_view_that_is_held_out_by_its_first_sample(measured, trained) -> None:
    run, rows = trained(), measured.held_out()
    found = compare(measured.store, [run], references=measured.references)
    (row,) = found.rows
    assert found.measured == tuple(rows[::2]), "the two passes of a view follow each other"
    assert found.samples == len(rows) // 2 == len(row.held_out.per_sample) == len(row.held_out.units)
    assert found.units == row.held_out.error.count == row.metrics.images == len(rows) // 2
    half_spp = measured.scene.spec.transport.half_spp
    assert found.references == References(len(rows) // 2, 2 * 2 * half_spp, 1 / 4)
    assert (row.metrics.fid is None) == (find_weights() is None)
    assert row.metrics.flip.estimate.mean > 0
    assert 0 < row.seconds.low <= row.seconds.median <= row.seconds.high < 10
    assert found.document()["rows"][0]["network_seconds_range"] == [row.seconds.low, row.seconds.high]


def test_the_row_of_the_metric_space_is_that_of_the_predictors_images(measured, trained) -> None:
    """What is shown as it is, against references read by hand."""
    found = compare(measured.store, [trained()], [("none", 1)], references=measured.references, most=3, **QUICK)
    reader, rows = measured.reader(), measured.held_out()[::2][:3]
    images = [reader.read(row).radiance[0] for row in rows]
    wanted = [MergedView.read(measured.references / f"{reader.view_key(row).hex()}.npz") for row in rows]
    halves = (np.array([getattr(of, half) for of in wanted], np.float32) for half in ("half_a", "half_b"))
    expected = mse(metric_space(np.array(images, np.float32)), *map(metric_space, halves), having_seen_a=True)
    assert reader.spec.exposure == 1
    assert found.rows[1].name == "none 1/1"
    assert found.rows[1].metrics.mse.values == pytest.approx(expected.tolist(), rel=1e-5)
    assert found.rows[1].metrics.fid is found.rows[1].metrics.feature_l1 is None, "without Inception"


def test_what_is_given_several_halves_has_the_mean_of_a_over_as_many_passes_and_an_error_by_b_alone(
    measured, trained
) -> None:
    amounts, references = [("none", 1), ("none", 4)], measured.references
    found = compare(measured.store, [trained()], amounts, halves=[2], references=references, **QUICK)
    one, _, two = found.rows[1:]
    assert (two.name, two.halves, two.shown) == ("none 2/1", 2, {})
    assert draw_comparison(found).shape[1] == 4 * 256 + 3 * 8
    with Feed(measured.reader(), trained().settings, needs=Needs(points=False, kept=1, halves=2)) as feed:
        (batch,) = read_batches(feed, found.measured[:1], 1)
    reader = measured.reader()
    passes = [reader.read(row).radiance[0] for row in (found.measured[0], found.measured[0] + 1)]
    np.testing.assert_allclose(batch.inputs.noisy.colour[0], np.mean(passes, axis=0), rtol=1e-6)
    ratio = two.metrics.mse.estimate.mean / one.metrics.mse.estimate.mean
    assert 0.4 < ratio < 0.7, "half of the noise, up to the display's curve"
    assert "denoisers: up to 50.0% of a reference" in format_evaluation(found)
    with pytest.raises(IncompleteError, match="none 3/1: no held-out view has 3 passes"):
        compare(measured.store, [trained()], [("none", 1)], halves=[3], **QUICK)


def test_a_network_of_halves_is_given_several_with_their_number_and_their_variance(measured, trained) -> None:
    run = trained(network={"width": 4, "architecture": "guided_denoise", "filter": "own"})
    found = compare(measured.store, [run, trained()], halves=[2], references=measured.references, **QUICK)
    one, _, two = found.rows
    assert (one.name, one.halves, two.name, two.halves, two.shown) == ("guided_denoise", 1, "guided_denoise 2/1", 2, {})
    assert 0 < two.held_out.error.mean < one.held_out.error.mean
    assert 0 < two.metrics.mse.estimate.mean < one.metrics.mse.estimate.mean
    reader, several = measured.reader(), replace(run, halves=2)
    (batch,) = read_in_turn(reader, found.measured[:1], 1, several.needs, run.settings.network.points)
    passes = np.stack([reader.read(row).radiance[0] for row in (found.measured[0], found.measured[0] + 1)])
    noisy = batch.inputs.noisy
    assert noisy.passes.tolist() == [2]
    np.testing.assert_allclose(noisy.colour[0], passes.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(noisy.variance[0], passes.mean(axis=-1).var(axis=0, ddof=1) / 2, rtol=1e-4, atol=1e-6)
    assert torch.equal(batch.target[0], torch.from_numpy(reader.read(found.measured[0]).radiance))
    with pytest.raises(SpecError, match="halves = 2: no run is of a network of halves"):
        compare(measured.store, [trained()], halves=[2], **QUICK)


def test_runs_and_denoisers_are_rows_of_one_table_which_each_run_keeps(measured, trained, tmp_path: Path) -> None:
    pytest.importorskip("mitsuba_oidn", reason="the extra `oidn` is not installed")
    runs = [TrainedRun.load(measured.runs[1]), trained(seed=1)]
    named = ["--store", measured.store, "--references", measured.references]
    named += [argument for run in runs for argument in ("--run", run.folder)]
    arguments = ["evaluate", *named, "--denoiser", "oidn", "--denoiser", "fill-in", "--kept", 4, "--samples", 3]
    result = CliRunner().invoke(umbrella, [str(a) for a in (*arguments, "--inception", tmp_path / "none")])
    assert isinstance(result.exception, StoreError), "weights that are named must be there"
    result = CliRunner().invoke(umbrella, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0
    lines = [line for line in result.stdout.splitlines() if line.startswith("|")]
    rows = [line.removeprefix("| ").split(" ")[0] for line in lines[2:]]
    assert rows == ["denoise_4", "light_transport", "oidn", "fill-in"]
    assert lines[0].count("|") == lines[-1].count("|")
    said = result.stderr.splitlines()
    assert said[0] == "networks are loaded and timed", "each part of the work is told"
    of_samples = [line for line in said if line.endswith(": 3 samples")]
    assert of_samples == [f"{runs[0].name}, oidn 1/4, fill-in 1/4: 3 samples", f"{runs[1].name}: 3 samples"]
    documents = [json.loads((run.folder / EVALUATION).read_text()) for run in runs]
    assert documents[0] == documents[1]
    assert documents[0]["rows"][2]["predictor"] == "oidn 1/4"
    assert documents[0]["rows"][2]["linear_mse"]["mean"] < documents[0]["rows"][0]["linear_mse"]["mean"]
    pictures = [np.asarray(Image.open(run.folder / COMPARISON)) for run in runs]
    assert np.array_equal(*pictures)


def test_predictors_that_read_the_same_read_each_sample_once(measured, trained, monkeypatch) -> None:
    """Beside the sample that each is timed on, and those that are shown."""
    read: list[int] = []
    whole = SceneReader.read_batch

    def counted(self: SceneReader, rows: Any, *into: Any) -> Any:
        read.extend(np.asarray(rows).tolist())
        return whole(self, rows, *into)

    monkeypatch.setattr(SceneReader, "read_batch", counted)
    alone = compare(measured.store, [TrainedRun.load(measured.runs[1])])
    once = len(read)
    assert once == alone.samples + 1 + len(alone.shown)
    read.clear()
    found = compare(measured.store, [TrainedRun.load(measured.runs[1]), trained()], [("none", 4), ("fill-in", 4)])
    assert len(read) == once + 3 + found.samples, "the other run reads points, and no noisy colour"
    assert [row.name for row in found.rows][2:] == ["none 1/4", "fill-in 1/4"]
    assert found.rows[0].held_out.per_sample.tolist() == alone.rows[0].held_out.per_sample.tolist()


def test_the_foot_says_what_the_figures_cannot(measured) -> None:
    """One half A of a view of 2 passes is a quarter of its reference."""
    runs = [TrainedRun.load(measured.runs[1])]
    found = compare(measured.store, runs, references=measured.references, most=4)
    head, _, foot = format_evaluation(found).split("\n\n")
    assert head.startswith("analytic: 4 held-out views of 4 configurations, one sample of each; noise")
    assert f"references: of {found.references.views} views, of {found.references.spp} samples per pixel" in foot
    assert f"or more; intervals over their {found.units} configurations; of so few they are wide" in foot
    assert "not converged, which takes 4096" in foot
    assert "denoisers: up to 25.0% of a reference is the half A, or the halves, that they were given" in foot
    assert "nor is rendering the 1/k of the pixels that denoisers are given" in foot
    if find_weights() is not None:
        assert f"FID of {found.references.views} images: below 2048" in foot
        assert "the published ones" in foot
    bare = replace(found, rows=tuple(replace(row, metrics=replace(row.metrics, inception=None)) for row in found.rows))
    assert "no weights of the Inception network are installed" in list_notes(bare)[-1]
    left_out = format_evaluation(replace(bare, has_inception=False))
    assert "| FLIP |" in left_out
    assert not re.search("FID|KID|Feature|Inception", left_out), "left out, as asked"
    converged = replace(found, references=replace(found.references, spp=4096))
    assert list_notes(converged)[1].endswith("; converged")


def test_the_pictures_stand_side_by_side_in_one_exposure(measured, trained) -> None:
    """Each 256 pixels wide, 8 apart, below a line of text of 18: the target, then what was given as it is."""
    reader, run = measured.reader(), trained()
    for folder, first in ((None, "radiance"), (measured.references, "reference")):
        found = compare(measured.store, [run], [("none", 1)], references=folder, most=5, **QUICK)
        sheet = draw_comparison(found)
        assert sheet.shape[1] == 3 * 256 + 2 * 8
        assert len({reader.modification_key(target.row) for target in found.shown}) == len(found.shown) == 4
        for place, target in enumerate(reversed(found.shown)):
            bottom = sheet.shape[0] - place * (256 + 18 + 8)
            shown = [sheet[bottom - 256 : bottom, x : x + 256][::16, ::16] for x in (0, 2 * 264)]
            radiance = reader.read(target.row).radiance
            wanted = radiance.mean(axis=0)
            if first == "reference":
                wanted = MergedView.read(measured.references / f"{reader.view_key(target.row).hex()}.npz").mean
            for picture, image in zip(shown, (wanted, radiance[0]), strict=True):
                assert np.abs(picture.astype(int) - display(image, reader.spec.exposure)).max() <= 1


def test_a_chosen_row_is_shown_once_and_the_document_says_which_row_each_picture_is_of(measured, trained) -> None:
    how = {"references": measured.references, **QUICK}
    first = compare(measured.store, [trained()], **how).document()["shown"]
    other = next(row for row in measured.held_out()[::2] if row not in first)
    chosen = [first[1], other, first[0], other]
    found = compare(measured.store, [trained()], choose=lambda *_: chosen, **how)
    assert found.document()["shown"] == [*first, other]
    fewer = draw_comparison(replace(found, shown=found.shown[:4]))
    assert draw_comparison(found).shape[0] == fewer.shape[0] + 256 + 18 + 8


@pytest.mark.parametrize("arguments", [["--kept", "4"], ["--inception", "file"], ["room"]])
def test_options_that_would_do_nothing_are_refused(arguments: list[str]) -> None:
    result = CliRunner().invoke(umbrella, ["evaluate", *arguments])
    assert result.exit_code == 2
    assert arguments[0] in result.stderr


def test_predictors_are_timed_by_turns_after_rounds_that_do_not_count(make_source, tiny) -> None:
    """Rounds are slow at first, and in a sixth of those that count: the median and the range are of the others."""
    calls = []

    def predictor(name: str, slower: float) -> DevicePredictor:
        def images(inputs) -> torch.Tensor:
            calls.append(name)
            number = calls.count(name)
            until = (
                slower + (0.2 if number <= WARM_ROUNDS or number == WARM_ROUNDS + 5 else 0.005) + time.process_time()
            )
            time.sleep(0.01)  # which is not the processor's
            while time.process_time() < until:
                pass
            return inputs.albedo

        return DevicePredictor(images, torch.device("cpu"))

    predictors = [predictor("a", 0.0), predictor("b", 0.03)]
    with Feed(make_source(3), tiny(), needs=Needs(points=False)) as feed:
        batch = next(read_batches(feed, [0], 1))
        pairs = [(predict, predict.of_its_own(batch.inputs)) for predict in predictors]
        kept = pairs[0][1].albedo.clone()
        batch.inputs.albedo.zero_()
        assert torch.equal(pairs[0][1].albedo, kept), "the feed's memory is used again"
    a, b = time_by_turns(pairs)
    assert calls == ["a", "b"] * (WARM_ROUNDS + TIMED_ROUNDS)
    assert 0.005 <= a.low <= a.median <= a.high < 0.01
    assert 0.035 <= b.low <= b.median <= b.high < 0.04


def test_without_references_only_the_linear_error_is_given(measured, trained) -> None:
    found = compare(measured.store, [trained()], most=3)
    assert found.samples == 3
    assert found.references is found.rows[0].metrics is None
    assert "MSSIM" not in format_evaluation(found)
    assert "no references: the columns of the paper need them" in list_notes(found)[-1]
    assert found.document()["rows"][0]["metric_space"] is None


def test_how_far_a_row_is_behind_the_first_is_taken_in_pairs(measured, trained) -> None:
    """A run has no difference at all from itself; in general it is that of the means."""
    run = trained()
    first, same, other = compare(measured.store, [run, run], [("none", 4)]).rows
    assert (same.behind(first).mean, same.behind(first).standard_error) == (0, 0)
    assert other.behind(first).mean == pytest.approx(other.held_out.error.mean - first.held_out.error.mean)
    assert other.behind(first).count == first.held_out.error.count


def test_runs_with_different_shares_are_measured_on_what_none_has_seen(measured, trained) -> None:
    runs = [trained(hold_out=0.6), trained(hold_out=0.3)]
    fewer, more = (len(measured.held_out(share)) // 2 for share in (0.3, 0.6))
    assert compare(measured.store, runs).samples == fewer < more


def test_what_cannot_be_compared_is_refused(measured, trained, make_source, tiny, tmp_path: Path) -> None:
    train(make_source(12, moving=False), tiny(max_steps=1), tmp_path / "static")
    static = TrainedRun.load(tmp_path / "static")
    for folder in ("empty", "small"):
        (tmp_path / folder).mkdir()
    for file in measured.references.iterdir():
        MergedView(1, *np.zeros((4, 8, 8, 3))).write(tmp_path / "small" / file.name)
    refused: list[tuple[str, dict[str, Any]]] = [
        (static.scene_id, {"runs": [trained(), static]}),
        ("300", {"denoisers": [("none", 300)]}),
        ("device = 'cuda:99'", {"device": "cuda:99"}),
        (r"\(8, 8, 3\)", {"references": tmp_path / "small"}),
    ]
    for named, asked in refused:
        with pytest.raises(SpecError, match=named):
            compare(measured.store, **{"runs": [trained()], **asked})
    for folder in ("missing", "empty"):
        with pytest.raises(StoreError, match=f"{folder}: "):
            compare(measured.store, [trained()], references=tmp_path / folder)


def test_a_store_with_nothing_held_out_says_so(scene: SceneStore, commit, make_source, tiny, tmp_path: Path) -> None:
    train(make_source(24), tiny(max_steps=1), tmp_path / "run")
    spec = scene.spec
    keys = {seed: sample_modification(spec, seed, 0).key(spec.radiance_id) for seed in range(32)}
    seed = next(seed for seed, key in keys.items() if are_held_out([key], tiny().hold_out) == [False])
    scene.plan(Request(modifications=1, seed=seed), shard_rows=8)
    commit(scene, 0)
    with pytest.raises(IncompleteError, match=r"none .* held out"):
        compare(scene.folder.parent.parent, [TrainedRun.load(tmp_path / "run")])
