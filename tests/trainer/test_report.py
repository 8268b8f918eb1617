"""A run on a real store, filled while it trains, and its report."""

import json
import re
import threading
import time
from html.parser import HTMLParser

import numpy as np
import pytest

from photonfarm.shared.errors import IncompleteError, SpecError, StoreError
from photonfarm.shared.plan import Request
from photonfarm.trainer.curve import Level, learning_curve
from photonfarm.trainer.dataset import rows_held_out
from photonfarm.trainer.loop import SETTINGS, train
from photonfarm.trainer.report import write_report
from photonfarm.trainer.store_source import StoreSource
from photonfarm.trainer.waits import bottleneck


def test_a_store_is_trained_on_while_it_fills_and_reported(scene, commit, tiny, run, tmp_path) -> None:
    store = scene.folder.parent.parent
    scene.plan(Request(modifications=10, views_per_modification=2, passes=2, seed=0), shard_rows=8)
    assert scene.jobs() == 5

    begun = threading.Event()

    def fill() -> None:
        assert begun.wait(60)
        for job in range(5):
            time.sleep(0.4)
            commit(scene, job)

    worker = threading.Thread(target=fill)
    worker.start()
    settings = tiny(max_steps=40, replay_ratio=1.0, replay_buffer=0)
    outcome = train(StoreSource(store, scene.scene_id), settings, run, count=lambda *_: begun.set())
    worker.join()
    figures = write_report(store, run, tmp_path / "out")

    assert json.loads((tmp_path / "out/report.json").read_text()) == figures
    assert figures["samples_committed"] == figures["samples_planned"] == 40
    assert figures["train_steps"] == outcome.step == 40
    waited_s, total_s = figures["seconds"]["wait_data"], sum(figures["seconds"].values())
    assert 0.35 < waited_s < total_s, "of the first job, at least, there was nothing but to wait"
    assert figures["waits"]["samples"] == pytest.approx(waited_s / total_s, abs=1e-4)
    assert figures["bottleneck"] == bottleneck(figures["waits"])
    assert figures["samples_per_used"] == 1.0
    assert figures["samples_per_core_second"] == pytest.approx(40 / (5 * 0.5))
    assert figures["val_error_last"] < figures["val_error_first"]
    assert figures["noise_floor"] > 0
    assert figures["val_error_mean_colour"] > 0
    assert figures["samples_held_out"] == 4 * figures["configurations_held_out"], "two views of two passes each"

    page = (tmp_path / "out/report.html").read_text()
    assert page.count("data:image/png;base64,") == 4 * min(6, figures["samples_held_out"])
    assert not re.search(r'(src|href)="(?!data:)', page), "nothing is loaded from elsewhere"
    assert not re.search(r"\bnan\b", page)
    assert_balanced(page)


def test_the_samples_of_a_store_reach_the_trainer(scene, commit) -> None:
    source = StoreSource(scene.folder.parent.parent, scene.scene_id)
    assert source.ready()
    assert len(source.refresh()) == source.planned() == 0
    scene.plan(Request(modifications=4, views_per_modification=2, passes=2), shard_rows=8)
    assert commit(scene, 0)
    rows = source.refresh()
    assert (len(rows), source.planned()) == (8, 16)
    one, other = source.read_batch(rows[:2].tolist())
    assert one.radiance.shape == (2, 16, 16, 3)
    assert not np.array_equal(one.radiance[0], one.radiance[1])
    keys = source.view_keys(rows.tolist())
    assert keys[0] == keys[1], "two passes of one view"
    assert keys[0] != keys[2]
    np.testing.assert_array_equal(one.buffers.depth, other.buffers.depth)
    assert len(set(rows_held_out(source, rows[:4].tolist(), 0.5))) == 1


def test_a_store_without_the_scene_is_not_ready(tmp_path) -> None:
    assert not StoreSource(tmp_path / "nothing", "0" * 32).ready()


def test_a_folder_that_is_no_run_is_refused(tmp_path) -> None:
    with pytest.raises(SpecError, match="is not a training run"):
        write_report(tmp_path / "store", tmp_path / "run", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_report_of_a_store_that_is_none_is_refused(make_source, tiny, run, tmp_path) -> None:
    train(make_source(24), tiny(max_steps=1), run)
    with pytest.raises(StoreError, match="is not a store"):
        write_report(tmp_path / "store", run, tmp_path / "out")


def test_a_report_without_held_out_samples_says_so(scene, commit, make_source, tiny, run, tmp_path) -> None:
    source = make_source(24)
    train(source, tiny(max_steps=1), run)
    scene.plan(Request(modifications=1), shard_rows=8)
    commit(scene, 0)
    with pytest.raises(IncompleteError, match="samples are complete; a report needs both"):
        write_report(scene.folder.parent.parent, run, tmp_path / "out")


def test_one_held_out_configuration_of_a_cuda_run_is_reported_without_nan(scene, commit, tiny, run, tmp_path) -> None:
    scene.plan(Request(modifications=8, views_per_modification=2), shard_rows=16)
    commit(scene, 0)
    source = StoreSource(scene.folder.parent.parent, scene.scene_id)
    shares = np.linspace(0.01, 0.9, 90)
    rows = source.refresh()
    share = next(s for s in shares if sum(rows_held_out(source, rows.tolist(), s)) == 2)
    store = scene.folder.parent.parent
    train(StoreSource(store, scene.scene_id), tiny(max_steps=1, hold_out=share, minimum_samples=1), run)
    settings = json.loads((run / SETTINGS).read_text())
    (run / SETTINGS).write_text(json.dumps({**settings, "device": "cuda"}))
    write_report(store, run, tmp_path / "out")
    assert json.loads((tmp_path / "out/report.json").read_text())["val_error_last_standard_error"] is None
    assert "NaN" not in (tmp_path / "out/report.json").read_text()
    assert "(± –)" in (tmp_path / "out/report.html").read_text()
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot write the report"):
        write_report(store, run, tmp_path / "file")


def test_a_learning_curve_names_its_axes_and_puts_smaller_errors_lower() -> None:
    svg = learning_curve([(0, 1.0), (50, 0.1), (100, 0.02)], [Level("mean colour", 0.3, "#123456")], "training steps")
    assert_balanced(svg)
    assert ">training steps<" in svg
    assert ">held-out squared error<" in svg
    assert ">mean colour<" in svg
    assert ">100<" in svg
    assert ">0.1<" in svg
    points = [tuple(map(float, p.split(","))) for p in re.search(r'points="([^"]*)"', svg)[1].split()]
    assert points == sorted(points)
    assert [y for _, y in points] == sorted(y for _, y in points)


@pytest.mark.parametrize("points", [[(0, 1.0)], [(0, -0.1), (10, -0.2)], []])
def test_a_learning_curve_is_drawn_of_few_or_negative_errors_too(points: list[tuple[float, float]]) -> None:
    svg = learning_curve(points, [], "steps")
    assert_balanced(svg)
    assert "nan" not in svg


class _Balance(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, _attrs: object) -> None:
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def assert_balanced(markup: str) -> None:
    parser = _Balance()
    parser.feed(markup)
    assert parser.open == []
