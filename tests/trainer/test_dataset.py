"""What is read, held out and kept in memory."""

import numpy as np
import pytest

from photonfarm.shared.errors import CorruptError
from photonfarm.shared.view import Camera
from photonfarm.trainer.dataset import Compact, is_row_held_out
from photonfarm.trainer.feed import Feed


def test_no_configuration_is_on_both_sides_of_the_hold_out(make_source) -> None:
    source = make_source(800, views=4)
    held = [is_row_held_out(source, row, 1 / 8) for row in range(800)]
    sides = {side: {source.modification_key(r) for r in range(800) if held[r] is side} for side in (True, False)}
    assert not sides[True] & sides[False]
    assert abs(len(sides[True]) - 25) <= 3 * np.sqrt(200 / 8 * 7 / 8), "binomial, 3 σ"


def test_what_is_held_out_for_a_small_share_is_held_out_for_a_larger_one(make_source) -> None:
    source = make_source(200)
    small, large = ({r for r in range(200) if is_row_held_out(source, r, share)} for share in (1 / 16, 1 / 4))
    assert small < large


def test_a_static_scene_is_split_by_views(make_source) -> None:
    source = make_source(200, moving=False)
    held = sum(is_row_held_out(source, row, 1 / 4) for row in range(200))
    assert abs(held - 50) <= 3 * np.sqrt(200 * 3 / 16), "binomial, 3 σ"


def test_a_batch_holds_the_samples_exactly(make_source, tiny) -> None:
    source = make_source(6)
    with Feed(source, tiny()) as feed:
        feed.ask([4, 1])
        batch = feed.take()
        assert batch.rows == (4, 1)
        for place, row in enumerate(batch.rows):
            sample = source.read(row)
            position, visible = source.cloud_at(row)
            camera = Camera.of(sample.view, source.spec).world_to_camera
            for found, wanted in (
                (batch.target, sample.radiance * np.float32(source.spec.exposure)),
                (batch.inputs.position, position),
                (batch.inputs.visible, visible),
                (batch.inputs.world_to_camera, camera.astype(np.float32)),
                (batch.inputs.depth, sample.buffers.depth),
                (batch.inputs.albedo, sample.buffers.albedo),
                (batch.inputs.normal, sample.buffers.normal),
            ):
                np.testing.assert_array_equal(found[place].numpy(), wanted)


@pytest.mark.parametrize(("scale", "dtype"), [(1.0, np.float16), (1e6, np.float32), (1 / 3, np.float32)])
def test_keeping_a_sample_in_memory_changes_no_bit(make_source, scale: float, dtype: type) -> None:
    source = make_source(1)
    sample = source.read(0)
    sample.radiance[:] = np.float32(scale) * np.round(64 * sample.radiance) / 64
    kept = Compact.of(sample, source.spec)
    assert kept.radiance.dtype == dtype
    np.testing.assert_array_equal(kept.radiance.astype(np.float32), sample.radiance)


def test_memory_is_used_up_to_its_budget_and_not_beyond(make_source, tiny) -> None:
    source = make_source(6)
    each = Compact.of(source.read(0), source.spec).nbytes
    source.reads.clear()
    with Feed(source, tiny(cache_bytes=int(2.5 * each))) as feed:
        for _ in range(3):
            for rows in ([0, 1, 2], [3, 4, 5]):
                feed.ask(rows)
                feed.take()
    assert sorted(source.reads) == sorted([0, 1] + 3 * [2, 3, 4, 5])


def test_batches_use_the_same_memory_again(make_source, tiny) -> None:
    with Feed(make_source(6), tiny(prefetch=2)) as feed:
        places = set()
        for i in range(12):
            feed.ask([i % 6])
            places.add(feed.take().target.data_ptr())
    assert len(places) == 3


def test_an_error_of_the_source_reaches_the_one_who_takes(make_source, tiny) -> None:
    source = make_source(3)

    def read(row: int) -> None:
        raise CorruptError(f"row {row}: checksum differs")

    source.read = read
    with Feed(source, tiny()) as feed:
        feed.ask([1])
        with pytest.raises(CorruptError, match="row 1"):
            feed.take()
        with pytest.raises(CorruptError, match="row 1"):
            feed.arrivals()


def test_rows_are_told_as_they_arrive_and_when_all_have(make_source, tiny) -> None:
    with Feed(make_source(10, per_look=4), tiny()) as feed:
        rows, complete = feed.arrivals()
        assert [row for row, _ in rows] == [0, 1, 2, 3][: len(rows)]
        while not complete:
            more, complete = feed.arrivals()
            rows += more
    assert [row for row, _ in rows] == list(range(10))
