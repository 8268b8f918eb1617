"""What is read, held out and kept in memory."""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from analytic_room import render, visibility
from analytic_room_samples import known

from photonfarm.core.errors import CorruptError, IncompleteError, SpecError
from photonfarm.core.records import LIT_POINTS, ViewBuffers, Visibility
from photonfarm.data import open_scene
from photonfarm.plan.hold_out import are_held_out, rows_held_out
from photonfarm.plan.request import Joined, PlannedContent, Request, SamplesToPlan, expand, samples_to_join
from photonfarm.plan.top_up import TopUp
from photonfarm.scene.view import Camera
from photonfarm.store import Figures, JobWriter, SceneReader, Store
from photonfarm.store.check.check import check_store
from photonfarm.trainer.data.batch_stream import BatchStream
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.runs.devices import Ranks


def test_no_configuration_is_on_both_sides_of_the_hold_out(make_source) -> None:
    source = make_source(800, views=4)
    held = rows_held_out(source, range(800), 1 / 8)
    sides = {side: {source.modification_key(r) for r in range(800) if held[r] is side} for side in (True, False)}
    assert not sides[True] & sides[False]
    assert abs(len(sides[True]) - 25) <= 3 * np.sqrt(200 / 8 * 7 / 8), "binomial, 3 σ"


def test_a_static_scene_is_split_by_views(make_source) -> None:
    source = make_source(200, moving=False)
    held = sum(rows_held_out(source, range(200), 1 / 4))
    assert abs(held - 50) <= 3 * np.sqrt(200 * 3 / 16), "binomial, 3 σ"


def test_what_was_not_drawn_uniformly_is_never_held_out_nor_trained_on_beside_what_is(scene, commit, tiny) -> None:
    scene.plan(Request(modifications=16), shard_rows=8)
    rows = expand(scene.spec, Request(modifications=16, seed=1), PlannedContent(), first_job=0, shard_rows=8).rows
    configuration, view = np.ones(16, np.float32), np.ones(16, np.float32)
    configuration[:8], configuration[8:12], view[12:] = 2, np.nan, 0.5  # likelier, by hand, a rarer view

    def choose(known: PlannedContent) -> SamplesToPlan:
        samples = samples_to_join(PlannedContent([(0, rows)]), np.arange(16), known)
        return replace(samples, modification_density=configuration, view_density=view)

    scene.plan(Joined(store="other", samples=16), samples=choose)
    for job in range(4):
        commit(scene, job)
    source, settings = SceneReader(scene.storage.root, scene.scene_id), tiny(prefetch=32, hold_out=0.4)
    with Feed(source, settings) as feed:
        stream = BatchStream(feed, settings, Ranks())
        stream.draw_ahead(32)
        drawn = {row for rows in stream.state()["asked"] for row in rows}
    kept_apart = np.array(are_held_out(source.modification_keys(range(32)), 0.4))
    assert all(kept_apart[part].any() for part in (slice(0, 16), slice(16, 24), slice(24, 28), slice(28, 32)))
    held_out = [row for row in range(16) if kept_apart[row]]
    assert stream.held_out == held_out
    assert set(stream.training_rows) == drawn, "the others do not count where training begins"
    assert len(stream.arrived) == 32, "but as used, or workers would wait for ever"
    assert drawn == set(np.flatnonzero(~kept_apart).tolist())
    opened = open_scene(scene.storage.root, scene.scene_id)
    assert opened.split("held-out", hold_out=0.4).rows.tolist() == held_out
    assert set(opened.split("train", hold_out=0.4).rows.tolist()) == drawn
    told = scene.plan(TopUp.of("+8", ["held-out=0.4"]), shard_rows=8)
    assert told.new == len(held_out)


@pytest.mark.parametrize("moving", [True, False])
def test_a_batch_names_the_units_by_which_its_samples_are_held_out(make_source, tiny, moving: bool) -> None:
    source = make_source(6, views=2, moving=moving)
    with Feed(source, tiny()) as feed:
        feed.ask([4, 5, 1])
        units = feed.take().units
    assert list(units) == (source.modification_keys if moving else source.view_keys)([4, 5, 1])
    assert are_held_out(units, 0.5) == rows_held_out(source, [4, 5, 1], 0.5)


@pytest.mark.parametrize("exposure", [1.0, 3.0])
def test_a_batch_holds_the_samples_exactly(make_source, tiny, exposure: float) -> None:
    source = make_source(6, exposure=exposure)
    with Feed(source, tiny()) as feed:
        feed.ask([4, 1])
        batch = feed.take()
        assert batch.rows == (4, 1)
        for place, row in enumerate(batch.rows):
            sample = source.read(row)
            position, present = source.cloud_at(row)
            camera = Camera.of(sample.view, source.spec).world_to_camera
            for found, wanted in (
                (batch.target, sample.radiance * np.float32(source.spec.exposure)),
                (batch.inputs.points.position, position),
                (batch.inputs.points.present, present),
                (batch.inputs.points.seen, sample.visibility.points),
                (batch.inputs.world_to_camera, camera.astype(np.float32)),
                (batch.inputs.depth, sample.buffers.depth),
                (batch.inputs.albedo, sample.buffers.albedo),
                (batch.inputs.normal, sample.buffers.normal),
            ):
                np.testing.assert_array_equal(found[place].numpy(), wanted)


@pytest.mark.parametrize("scene", [1.0, 3.0, 0.25], indirect=True, ids="exposure {}".format)
@pytest.mark.parametrize("brightest", [60.0, 1e6])
def test_a_batch_holds_what_was_committed_exactly_also_where_float16_cannot(scene, tiny, brightest: float) -> None:
    scene.plan(Request(modifications=2), shard_rows=2)
    rows = scene.job_rows(0)
    bright = np.zeros((2, 16, 16, 3), np.float32)
    bright[1, 3, 4] = brightest
    buffers = ViewBuffers(*(np.full((16, 16, *more), 0.25, np.float32) for more in ((), (3,), (3,))))
    guides = known(bright[0], buffers, min(LIT_POINTS, scene.spec.points))
    seen = np.random.default_rng(0).random(256) < 0.5
    with JobWriter(scene, scene.job_rows(0)) as out:
        for sample in rows.samples:
            out.radiance(sample.row, bright if sample.row == 1 else 0 * bright + 0.5)
            out.view(sample.view_row, buffers, guides, Visibility(seen, np.zeros(0, bool)))
        out.commit(Figures(core_s=1, wall_s=1, redrawn=0, worker="test", versions={"test": "1"}))
    with Feed(SceneReader(scene.storage.root, scene.scene_id), tiny()) as feed:
        feed.ask([1, 0])
        batch = feed.take()
        np.testing.assert_array_equal(batch.target[0], bright * np.float32(scene.spec.exposure))
        assert torch.equal(batch.target[1], torch.full((2, 16, 16, 3), 0.5 * scene.spec.exposure))
        assert torch.equal(batch.inputs.normal, torch.full((2, 16, 16, 3), 0.25))
        np.testing.assert_array_equal(batch.inputs.points.seen, [seen, seen])


def test_an_error_of_the_source_reaches_the_one_who_takes(make_source, tiny) -> None:
    source = make_source(3)

    def read(row: int) -> None:
        raise CorruptError(f"row {row}: checksum differs")

    source.read = read
    with Feed(source, tiny()) as feed:
        feed.ask([1])
        with pytest.raises(CorruptError):
            feed.take()
        with pytest.raises(CorruptError):
            feed.arrivals()


def test_rows_are_told_as_they_arrive_and_when_all_have(make_source, tiny) -> None:
    with Feed(make_source(10, per_look=4), tiny()) as feed:
        rows, complete = feed.arrivals()
        assert [row for row, _ in rows] == list(range(len(rows)))
        while not complete:
            more, complete = feed.arrivals()
            rows += more
    assert [row for row, _ in rows] == list(range(10))


@pytest.fixture
def repaired(scene, commit):
    """A scene of eight jobs of two samples, all committed; and what damages one and has it repaired."""
    scene.plan(Request(modifications=4, views_per_modification=4), shard_rows=2)
    for job in range(scene.jobs()):
        commit(scene, job)

    def repair(job: int) -> None:
        path = next((scene.folder / "plans/000000/radiance").glob(f"c.{job}.*"))
        path.write_bytes(path.read_bytes()[:-1])
        check_store(Store(scene.storage.root), when="now", repair=True)
        assert scene.missing_jobs() == [job]

    return scene, repair


def test_a_reader_without_a_presence_ends_where_what_it_reads_was_set_aside(repaired, tiny) -> None:
    """The reader still believes that it is complete, and its file is gone."""
    scene, repair = repaired
    with Feed(SceneReader(scene.storage.root, scene.scene_id), tiny(poll_seconds=600)) as feed:
        repair(7)
        feed.ask([14, 0, 15])
        with pytest.raises(IncompleteError, match=r"row 14 .* is not complete"):
            feed.take()


def test_quiet_begins_when_all_is_read_and_ends_with_what_is_missing(repaired, commit, tiny) -> None:
    scene, repair = repaired
    with Feed(SceneReader(scene.storage.root, scene.scene_id), tiny(poll_seconds=0.01)) as feed:
        feed.ask([0, 1])
        with feed.quiet():
            repair(0)
            feed.ask([0, 1])
            time.sleep(0.2)
            assert feed.missing == 0, "nothing is looked at"
        assert feed.take().rows == (0, 1), "was read before"
        commit(scene, 0)
        assert feed.take().rows == (0, 1), "waited for"
        assert feed.missing == 0


def test_where_a_look_at_the_store_takes_long_looks_are_rare(repaired, tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, _ = repaired
    source, looks = SceneReader(scene.storage.root, scene.scene_id), []
    plain = source.refresh

    def slow() -> Any:
        looks.append(time.monotonic())
        time.sleep(0.2)
        return plain()

    monkeypatch.setattr(source, "refresh", slow)
    with Feed(source, tiny(poll_seconds=0.01)) as feed:
        time.sleep(1.5)
        feed.ask([0])
        assert feed.take().rows == (0,), "batches do not wait for the next look"
    assert len(looks) == 1, "the next one is due 4 s after the first"


def test_skipped_views_alone_are_waited_for_while_more_are_to_come_and_refused_then(
    make_source, tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = tiny(skip_views=["near"], minimum_samples=1, poll_seconds=1e9)
    with Feed(make_source(24, per_look=12), settings) as feed:
        monkeypatch.setattr(feed, "is_skipped", lambda _: True)
        stream = BatchStream(feed, settings, Ranks())
        assert not stream.draw_ahead(1)
        with feed.quiet():
            pass  # it looks anew
        with pytest.raises(SpecError):
            stream.draw_ahead(1)


def test_views_that_are_skipped_are_never_drawn_and_stay_held_out(scene, commit, tiny) -> None:
    """Rows 0 to 3 are near, and so is 14 as it happens; without the setting they are drawn as all others are.

    Where rounds are limited, the others are drawn no more often for that.
    """
    scene.plan(Request(modifications=16), shard_rows=8)
    rows = scene.job_rows(0)
    with JobWriter(scene, rows) as out:
        for sample in rows.samples:
            shown = rows.modifications[sample.modification_row], rows.views[sample.view_row]
            clean, buffers = render(scene.spec, *shown)
            if sample.row < 4:
                buffers.depth[:8] = 1e-3
            out.radiance(sample.row, np.stack([clean, clean]))
            seen = visibility(scene.spec, scene.base()[1], *shown, None)
            out.view(sample.view_row, buffers, known(clean, buffers, 256), seen)
        out.commit(Figures(core_s=1, wall_s=1, redrawn=0, worker="test", versions={"test": "1"}))
    commit(scene, 1)

    def drawn(**changes: Any) -> tuple[set[int], list[int]]:
        settings = tiny(prefetch=16, hold_out=0.1, **changes)
        with Feed(SceneReader(scene.storage.root, scene.scene_id), settings) as feed:
            stream = BatchStream(feed, settings, Ranks())
            stream.draw_ahead(16)
            return {row for rows in stream.state()["asked"] for row in rows}, stream.held_out

    everything, held_out = drawn()
    assert everything | set(held_out) == set(range(16))
    assert drawn(skip_views=["unlit", "near"]) == (everything - {0, 1, 2, 3, 14}, held_out)

    network = {"architecture": "guided_denoise", "width": 4, "points": 64, "filter": "own"}
    settings = tiny(prefetch=16, hold_out=0.1, network=network, rounds=2, skip_views=["near"])
    with Feed(SceneReader(scene.storage.root, scene.scene_id), settings) as feed:
        stream, again = (BatchStream(feed, settings, Ranks()) for _ in range(2))
        stream.draw_ahead(16)
        stream.look()
        assert stream.drawn == stream.last_step == 2 * len(everything - {0, 1, 2, 3, 14}) // settings.batch
        again.restore(stream.state())
        again.complete = stream.complete
        assert not again.may_draw()
