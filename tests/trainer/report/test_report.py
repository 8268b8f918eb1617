"""A run on a real store, filled while it trains, and its report."""

import importlib
import json
import os
import re
import shutil
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from analytic_room_samples import commit_job
from click.testing import CliRunner
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from read_batches import batch_of

from photonfarm.cli.main import umbrella
from photonfarm.core.archives import Seconds
from photonfarm.core.errors import IncompleteError, StoreError
from photonfarm.plan.hold_out import rows_held_out
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.store import SceneReader, Store
from photonfarm.store.model.store import scene_status
from photonfarm.store.read.merge import MergedView
from photonfarm.trainer.compare.evaluate import PredictorRow
from photonfarm.trainer.metrics.image_metrics import confidence_interval, metric_space, mse, mssim
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.report import write_report
from photonfarm.trainer.report.contents import MOVABLE_LIGHTS
from photonfarm.trainer.report.data_and_runs import DatasetCard, PlanTotals, shorten_names
from photonfarm.trainer.report.frame_times import FrameTime
from photonfarm.trainer.report.plots import Plot, draw_plots
from photonfarm.trainer.runs.progress import find_bottleneck
from photonfarm.trainer.runs.run_folder import SETTINGS
from photonfarm.trainer.training.loop import Hooks, train


def test_a_store_is_trained_on_while_it_fills_and_reported(scene, commit, tiny, run, tmp_path) -> None:
    store = scene.folder.parent.parent
    scene.plan(Request(modifications=10, views_per_modification=2, passes=2, seed=0), shard_rows=8)
    assert scene.jobs() == 5
    begun = threading.Event()

    def fill() -> None:
        assert begun.wait(60)
        for job in range(5):
            time.sleep(0.1)
            commit(scene, job)

    worker = threading.Thread(target=fill)
    worker.start()
    settings = tiny(max_steps=40, replay_ratio=1.0, replay_buffer=0)
    outcome = train(SceneReader(store, scene.scene_id), settings, run, Hooks(on_draws=lambda *_: begun.set()))
    worker.join()
    told: dict[str, int] = {}
    figures = write_report(
        store, [run], tmp_path / "out", timed=False, on_progress=lambda what, done, _: told.update({what: done})
    )

    held_out = figures["evaluation"]["samples"]
    assert told == {
        "networks are loaded and timed": 0,
        "the mean colour of the training samples": 40 - 2 * held_out,
        TrainedRun.load(run).name: held_out,
        "the worst cases are looked for": 0,
        "plots and pages are drawn": 0,
    }
    assert json.loads((tmp_path / "out/report.json").read_text()) == figures
    dataset, (of_run,) = figures["dataset"], figures["runs"]
    assert dataset["samples_complete"] == dataset["samples_planned"] == 40
    assert of_run["steps"] == outcome.step == 40
    waited_s, total_s = of_run["seconds"]["wait_data"], sum(of_run["seconds"].values())
    assert 0.08 < waited_s < total_s, "of the first job, at least, there was nothing but to wait"
    assert of_run["waits"]["samples"] == pytest.approx(waited_s / total_s, abs=1e-4)
    assert of_run["bottleneck"] == find_bottleneck(of_run["waits"])
    assert of_run["samples_per_used"] == 1.0
    assert of_run["trained_on"] == 40 - 2 * figures["evaluation"]["samples"]
    assert of_run["curve"][-1]["used"] == of_run["trained_on"], "120 draws of fewer than 40 samples"
    assert all(0 < point["held_out"] <= 2 * figures["evaluation"]["samples"] for point in of_run["curve"])
    assert dataset["core_seconds_per_sample"] == pytest.approx(5 * 0.5 / 40)
    (row,) = figures["evaluation"]["rows"]
    assert row["linear_mse"]["mean"] < figures["untrained"]
    assert figures["evaluation"]["noise_floor"] > 0
    assert figures["mean_colour"] > 0
    assert figures["evaluation"]["samples"] == 2 * figures["evaluation"]["units"], "two views, of whose passes one"

    page = (tmp_path / "out/report.html").read_text()
    shown = min(4, figures["evaluation"]["units"])
    layers = ("noisy half", "prediction", "mean of both halves", "difference", "albedo", "normal", "depth")
    assert [page.count(f'<figure data-layer="{layer}"') for layer in layers] == [shown] * len(layers)
    assert page.count("data:image/png;base64,") == shown * len(layers)
    assert page.count("data:image/svg+xml;base64,") == 2, "curves over samples and everything"
    assert not re.search(r'(src|href)="(?!data:|#)|url\(|@import', page), "nothing is loaded from elsewhere"
    assert not re.search(r"\bnan\b", page)


def test_the_verb_ends_with_the_figures_of_a_display_and_where_the_pictures_are(
    measured, compared, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr("photonfarm.trainer.report.gather_contents", lambda *_, **__: compared)
    asked = ["--store", str(measured.store), "--run", str(measured.runs[0]), "--out", str(tmp_path)]
    said = CliRunner().invoke(umbrella, ["report", *asked])
    metrics = compared.entries[0].row.metrics
    assert f"MSSIM {metrics.mssim.estimate.mean:.3f}" in said.stderr
    assert said.stderr.splitlines()[-1] == f"side by side: {tmp_path / 'comparison.png'}"
    assert (tmp_path / "comparison.png").exists()


def test_what_cannot_be_reported_is_refused_before_anything_is_measured(
    scene, commit, make_source, tiny, run, tmp_path, monkeypatch
) -> None:
    """A folder that is no run, a store that is none or holds nothing held out, and folders that cannot be written."""
    with pytest.raises(StoreError):
        write_report(tmp_path / "none", [run], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    train(make_source(24), tiny(max_steps=1), run)
    with pytest.raises(StoreError):
        write_report(tmp_path / "none", [run], tmp_path / "out")
    scene.plan(Request(modifications=1), shard_rows=8)
    commit(scene, 0)
    with pytest.raises(IncompleteError):
        write_report(scene.folder.parent.parent, [run], tmp_path / "out")
    monkeypatch.setattr("photonfarm.trainer.report.gather_contents", lambda *_, **__: pytest.fail("it was measured"))
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file/further"):
        with pytest.raises(StoreError):
            write_report(scene.folder.parent.parent, [run], out)


def test_one_held_out_configuration_of_a_cuda_run_is_reported_without_nan(scene, commit, tiny, run, tmp_path) -> None:
    scene.plan(Request(modifications=8, views_per_modification=2), shard_rows=16)
    commit(scene, 0)
    store = scene.folder.parent.parent
    source = SceneReader(store, scene.scene_id)
    rows = source.refresh().tolist()
    share = next(s for s in np.linspace(0.01, 0.9, 90) if sum(rows_held_out(source, rows, s)) == 2)
    train(SceneReader(store, scene.scene_id), tiny(max_steps=1, hold_out=share, minimum_samples=1), run)
    settings = json.loads((run / SETTINGS).read_text())
    (run / SETTINGS).write_text(json.dumps({**settings, "device": "cuda"}))
    figures = write_report(store, [run], tmp_path / "out", timed=False)
    (row,) = figures["evaluation"]["rows"]
    assert row["linear_mse"]["standard_error"] is None
    assert figures["val_mse_metric"] is figures["val_mssim"] is None, "without references"
    assert "NaN" not in (tmp_path / "out/report.json").read_text()


def test_several_runs_and_denoisers_stand_beside_the_published_figures(measured, reported) -> None:
    figures, out = reported
    rows = {row["name"]: row for row in figures["evaluation"]["rows"]}
    assert list(rows) == ["light_transport", "denoise_4", "fill-in 1/4"]
    assert measured.scene.spec.lights, "of movable lights, so that the paper's second table is the one beside ours"
    assert figures["published_table"].startswith("Table 2")
    assert rows["light_transport"]["published"] == asdict(MOVABLE_LIGHTS["light_transport"])
    assert rows["fill-in 1/4"]["published"] is rows["fill-in 1/4"]["architecture"] is None
    assert figures["machine"]["cores"] == os.cpu_count()
    assert len(figures["machine"]["load_average"]) == 3
    page = (out / "report.html").read_text()
    own = next(line for line in page.splitlines() if line.startswith("<tr><td>light_transport</td>"))
    assert f"<td>{rows['light_transport']['metric_space']['mse']['estimate']['mean']:.5f} (" in own
    assert "<td>0.0029</td>" in own
    assert (out / "comparison.png").stat().st_size > 0


def test_the_figures_in_front_are_the_first_network_s_in_the_metric_space(measured, reported) -> None:
    """MSE less the references' noise, and MSSIM."""
    figures, _ = reported
    assert list(figures)[:2] == ["val_mse_metric", "val_mssim"], "for programs that compare reports"
    source, rows = measured.reader(), measured.held_out()[::2]
    assert len(rows) == figures["evaluation"]["units"] > 1
    run = TrainedRun.load(measured.runs[0])
    images = run.predictor(source.spec, source.base(), "cpu")(batch_of(source, rows, run.needs))
    merged = [MergedView.read(measured.references / f"{key.hex()}.npz") for key in source.view_keys(rows)]
    halves = [np.array([getattr(view, half) for view in merged], np.float32) for half in ("half_a", "half_b")]
    shown, a, b, mean = (metric_space(pictures) for pictures in (images, *halves, (halves[0] + halves[1]) / 2))
    assert figures["val_mse_metric"] == pytest.approx(mse(shown, a, b).mean(), rel=1e-5)
    assert figures["val_mssim"] == pytest.approx(mssim(shown, mean).mean(), rel=1e-5, abs=1e-6)


def uncertain(row: PredictorRow) -> PredictorRow:
    """A row whose error may be anything from 0 to twice what it is, and more."""
    found = row.metrics.mse
    known = replace(found, estimate=replace(found.estimate, standard_error=found.estimate.mean))
    return replace(row, metrics=replace(row.metrics, mse=known))


def test_a_predictor_has_one_colour_in_all_plots_and_bars_that_are_cut_end_at_the_axis(compared, monkeypatch) -> None:
    """The table's order is not that of the times, by which points are drawn."""
    times = [FrameTime({"buffers": Seconds(s, s, s), "network": Seconds(1.0, 1.0, 1.0)}) for s in (3.0, 2.0, 1.0)]
    entries = tuple(
        replace(entry, time=time, row=uncertain(entry.row)) for entry, time in zip(compared.entries, times, strict=True)
    )
    drawn = {}

    def kept(name: str, about: str, draw) -> Plot:
        drawn[name] = Figure().add_subplot()
        draw(drawn[name])
        return Plot(name, about, b"")

    module = importlib.import_module("photonfarm.trainer.report.plots")
    monkeypatch.setattr(module, "_draw", kept)
    monkeypatch.setattr(module, "FEW", 1)
    draw_plots(replace(compared, entries=entries))
    colours = {name: of_axes(axes) for name, axes in drawn.items()}
    assert list(colours["time-mse"]) == ["light_transport", "denoise_4", "fill-in"]
    assert len(set(colours["time-mse"].values())) == 3
    assert all(found.items() <= colours["time-mse"].items() for found in colours.values())
    assert set(colours["curve-samples"]) == {"light_transport", "denoise_4"}
    estimates = [entry.row.metrics.mse.estimate for entry in entries]
    assert min(confidence_interval(one)[0] for one in estimates) < min(one.mean for one in estimates) / 2
    least = min(one.mean for one in estimates)
    assert 0.499 * least < drawn["time-mse"].get_ylim()[0] < least
    assert drawn["time-mssim"].get_yscale() == "linear"


def test_a_plot_of_many_predictors_is_taller_by_the_rows_of_its_legend() -> None:
    def draw(count: int) -> float:
        module = importlib.import_module("photonfarm.trainer.report.plots")
        svg = module._draw("x", "", lambda axes: [axes.plot([1], [1], label=f"{n}") for n in range(count)]).svg
        return float(re.search(rb'height="([0-9.]+)pt"', svg)[1])

    assert draw(2) == draw(12)
    assert draw(30) > draw(12) + 100


def of_axes(axes: Axes) -> dict[str, str]:
    """The colours of an axes' predictors, as its legend has them."""
    handles = zip(*axes.get_legend_handles_labels(), strict=True)
    found = {label: handle[0] if isinstance(handle, ErrorbarContainer) else handle for handle, label in handles}
    levels = ("mean colour", "noise of the targets")
    return {label: line.get_color() for label, line in found.items() if label not in levels}


def test_the_dataset_s_card_says_whom_it_is_owed_to_and_how_it_was_made(measured, reported) -> None:
    figures, out = reported
    card, scene = figures["dataset"], measured.scene
    assert card["credits"] == scene.spec.credits.model_dump()
    assert [request["seed"] for request in card["requests"]] == [0]
    assert (card["bytes"], card["core_seconds"]) == (scene_status(scene).size_bytes, 4 * 0.5)
    assert card["versions"] == {"test": ["1"]}
    assert card["guides"] == scene.spec.guides.model_dump()
    page = (out / "report.html").read_text()
    assert "“A closed form” by Lambert &amp; Sons, CC0-1.0" in page, "what a spec says is text and no markup"


def test_passes_for_references_count_neither_as_samples_nor_as_their_cost(measured, tmp_path) -> None:
    """There are 32 samples in 4 jobs, then further passes; each job of these tests takes half a second."""
    shutil.copytree(measured.store, tmp_path / "store")
    scene = Store(tmp_path / "store").scene(measured.scene.scene_id)
    scene.plan(TopUp.of("+64", ["held-out=0.4"]))
    for job in range(4, scene.jobs()):
        commit_job(scene, job)
    card = DatasetCard.of(tmp_path / "store", scene.scene_id, 1.0)
    assert card.samples == PlanTotals(32, 32, 2.0)
    assert card.core_s_per_sample == 2.0 / 32
    further = card.status.samples_complete - 32
    assert card.further_passes == PlanTotals(further, further, 0.5 * (scene.jobs() - 4))
    assert further > 0


def test_runs_are_called_by_what_tells_them_apart(measured) -> None:
    runs = [TrainedRun.load(run) for run in measured.runs]
    assert shorten_names(runs) == ["light_transport", "denoise_4"]
    again = replace(runs[0], folder=runs[0].folder.parent / "again")
    assert shorten_names([runs[0], again]) == ["light_transport", "again"]
    elsewhere = replace(runs[0], folder=Path("elsewhere/light_transport"))
    assert shorten_names([runs[0], elsewhere]) == [str(runs[0].folder), "elsewhere/light_transport"]
