"""Passes merge exactly: the truth is Python's fractions, and neither order nor grouping leaves a trace."""

import json
from dataclasses import asdict, fields
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import store_samples as samples
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import IncompleteError, StoreError
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.read.merge import MergedView, Moments, merge_view

HALF = np.float32(np.finfo(np.float16).smallest_subnormal)
TINY, HUGE = np.finfo(np.float32).smallest_subnormal, np.finfo(np.float32).max

radiance = st.floats(width=32, allow_nan=False, allow_infinity=False) | st.floats(0, 4, width=16)


def passes_of(values: list[float]) -> list[np.ndarray]:
    """One-pixel passes, (2, 1, 1, 3) each: in channel 1, B and A are neighbours in the list."""
    pairs = np.array(values, np.float32).reshape(-1, 2)
    return [np.stack([np.roll([a, b, a], i).reshape(1, 1, 3) for i in range(2)]) for a, b in pairs]


def moments_of(passes: list[np.ndarray]) -> Moments:
    moments = Moments()
    for halves in passes:
        moments.add(halves)
    return moments


def assert_equal(a: MergedView, b: MergedView) -> None:
    for field in fields(MergedView):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), strict=True)


def truth(passes: list[np.ndarray], channel: int) -> tuple[float, float, float, float]:
    halves = [[Fraction(float(p[half, 0, 0, channel])) for p in passes] for half in range(2)]
    both = halves[0] + halves[1]
    mean = sum(both) / len(both)
    m2 = sum((x - mean) ** 2 for x in both)
    return float(mean), float(m2), *(float(sum(half) / len(half)) for half in halves)


@given(st.lists(radiance, min_size=2, max_size=12).filter(lambda values: len(values) % 2 == 0))
def test_mean_m2_and_both_half_means_are_the_exact_ones_rounded_once(values: list[float]) -> None:
    passes = passes_of(values)
    merged = moments_of(passes).merged()
    assert (merged.passes, merged.count) == (len(passes), len(values))
    for channel in range(3):
        found = tuple(float(image[0, 0, channel]) for image in (merged.mean, merged.m2, merged.half_a, merged.half_b))
        assert found == truth(passes, channel)


@given(st.lists(radiance, min_size=16, max_size=16), st.permutations(range(8)))
@settings(max_examples=60)
def test_any_order_gives_equal_bits(values: list[float], order: list[int]) -> None:
    passes = passes_of(values)
    assert_equal(moments_of([passes[i] for i in order]).merged(), moments_of(passes).merged())


def test_what_float64_would_lose_between_a_huge_and_a_tiny_value_is_kept() -> None:
    passes = passes_of([HUGE, TINY, -HUGE, TINY, HALF, 0.0])
    merged = moments_of(passes).merged()
    assert float(np.float64(HUGE) + TINY) == float(HUGE)
    assert merged.mean[0, 0, 1] == float((2 * Fraction(float(TINY)) + Fraction(float(HALF))) / 6)
    assert merged.m2[0, 0, 1] == truth(passes, 1)[1]


def test_what_cannot_be_merged_is_refused() -> None:
    moments = moments_of(passes_of([1.0, 2.0]))
    not_finite, other_size = np.full((2, 1, 1, 3), np.inf, np.float32), np.zeros((2, 2, 1, 3), np.float32)
    for halves, named in ((not_finite, "finite"), (other_size, r"\(2, 2, 1, 3\)")):
        with pytest.raises(ValueError, match=named):
            moments.add(halves)
    with pytest.raises(ValueError, match="no pass"):
        Moments().merged()


# -------------------------------------------------------------------------------------------------------------- a store


@pytest.fixture
def scene(tmp_path: Path) -> SceneStore:
    """Two views of one pass each, topped up by three passes."""
    store = Store(tmp_path / "store", create=True)
    request = Request(modifications=2)
    scene = store.scene(store.plan(samples.small_spec(), request, shard_rows=4).scene_id)
    scene.plan(TopUp.of("+24"))
    return scene


def reader_of(scene: SceneStore) -> SceneReader:
    reader = SceneReader(scene.folder.parent.parent, scene.scene_id)
    reader.refresh()
    return reader


def test_a_view_is_merged_from_all_of_its_complete_passes_and_from_no_other(scene: SceneStore) -> None:
    samples.commit_all(scene)
    reader = reader_of(scene)
    for view_row in (0, 1):
        rows = [s.row for job in range(scene.jobs()) for s in scene.job_rows(job).samples if s.view_row == view_row]
        assert len(rows) == 4
        expected = moments_of([samples.values(row, (2, 8, 8, 3)) for row in reversed(rows)]).merged()
        assert_equal(merge_view(reader, view_row), expected)


def test_passes_in_float16_and_in_float32_merge_alike(scene: SceneStore) -> None:
    given_ = samples.outputs(scene, 0)
    given_.radiance[1][0, 2, 3, 1] = 1e9
    samples.commit(scene, 0, given_)
    samples.commit_all(scene)
    merged, row_values = merge_view(reader_of(scene), 1), given_.radiance[1]
    others = [samples.values(int(row), (2, 8, 8, 3)) for row in reader_of(scene).rows_of_view(1) if row != 1]
    assert_equal(merged, moments_of([row_values, *others]).merged())
    assert merged.half_a[2, 3, 1] > 2e8


def test_a_merged_view_is_written_and_read_back(scene: SceneStore, tmp_path: Path) -> None:
    samples.commit_all(scene)
    merged = merge_view(reader_of(scene), 0)
    with pytest.raises(ValueError, match=r"\.npz"):
        merged.write(tmp_path / "view.exr")
    assert list(tmp_path.glob("view*")) == []
    merged.write(tmp_path / "view.npz")
    assert_equal(MergedView.read(tmp_path / "view.npz"), merged)
    with np.load(tmp_path / "view.npz") as stored:
        np.testing.assert_array_equal(stored["standard_error"], merged.standard_error)
    np.savez(tmp_path / "two.npz", **{**asdict(merged), "passes": [1, 2]})
    np.save(tmp_path / "array.npy", merged.mean)
    whole = (tmp_path / "view.npz").read_bytes()
    others = ((tmp_path / name).read_bytes() for name in ("two.npz", "array.npy"))
    for content in (b"nothing", whole[:3000], *others):
        (tmp_path / "other.npz").write_bytes(content)
        with pytest.raises(StoreError):
            MergedView.read(tmp_path / "other.npz")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(StoreError):
        MergedView.read(tmp_path / "folder.npz")


def test_the_command_writes_each_view_of_what_is_complete_and_again_when_more_is(
    scene: SceneStore, tmp_path: Path
) -> None:
    store, out = scene.storage.where, tmp_path / "references"
    arguments = ["store", "merge", "--store", store, "--out", str(out)]
    nothing = CliRunner().invoke(umbrella, arguments)
    assert isinstance(nothing.exception, IncompleteError)
    unplanned = CliRunner().invoke(umbrella, [*arguments, "--row", "9999"])
    assert isinstance(unplanned.exception, StoreError)
    few = CliRunner().invoke(umbrella, [*arguments, "--least", "512"])
    assert isinstance(few.exception, IncompleteError)
    codes = [result.exception.exit_code for result in (nothing, unplanned, few)]
    assert codes == [7, 4, 7]
    assert "--least" in str(few.exception)
    assert not out.exists()

    samples.commit(scene, 0, samples.outputs(scene, 0))
    one = CliRunner().invoke(umbrella, [*arguments, "--row", "0", "--json"], catch_exceptions=False)
    (told,) = json.loads(one.stdout)
    reader = reader_of(scene)
    assert (told["view"], told["passes"]) == (reader.view_key(0).hex(), 1)
    assert_equal(MergedView.read(Path(told["file"])), merge_view(reader, 0))

    samples.commit_all(scene)
    reader.refresh()
    result = CliRunner().invoke(umbrella, arguments, catch_exceptions=False)
    views = {reader.view_row(int(row)): int(row) for row in reader.rows}
    assert len(result.stdout.splitlines()) == len(views) == len(list(out.iterdir()))
    for view_row, row in views.items():
        assert_equal(MergedView.read(out / f"{reader.view_key(row).hex()}.npz"), merge_view(reader, view_row))
