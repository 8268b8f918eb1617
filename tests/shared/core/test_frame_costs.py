"""What a frame costs, as a file."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from photonfarm.core.archives import PARTS, FrameCosts, Seconds, Surface
from photonfarm.core.errors import StoreError


def made() -> FrameCosts:
    """Two rows of 3 × 4 pixels, three timed frames, images of all pixels and of a quarter."""
    rng = np.random.default_rng(0)
    surface = rng.integers(0, len(Surface), (2, 3, 4)).astype(np.uint8)
    parts = dict(zip(PARTS, rng.random((len(PARTS), 3)), strict=True))
    return FrameCosts(
        "abc",
        np.array([7, 3]),
        surface,
        **parts,
        kept=np.array([1, 4]),
        halves=np.array([8, 1]),
        render_s=rng.random((2, 3)),
    )


def test_costs_come_back_as_they_were_written(tmp_path: Path) -> None:
    costs = made()
    costs.write(tmp_path / "new/costs.npz")
    again = FrameCosts.read(tmp_path / "new/costs.npz")
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["costs.npz"]
    assert again.scene_id == "abc"
    for field in fields(FrameCosts)[1:]:
        written, read = getattr(costs, field.name), getattr(again, field.name)
        np.testing.assert_array_equal(read, written, err_msg=field.name)
        assert read.dtype == written.dtype, field.name


def test_medians_are_over_the_timed_frames() -> None:
    times = np.array([3.0, 1.0, 100.0])
    parts = {name: times * 10**place for place, name in enumerate(PARTS)}
    costs = replace(made(), **parts, render_s=np.array([[5.0, 4.0, 6.0], [0.2, 0.1, 9.0]]))
    assert [part.median for part in costs.parts().values()] == [3 * 10**place for place in range(len(PARTS))]
    assert {amount: render.median for amount, render in costs.renders().items()} == {(1, 8): 5, (4, 1): 0.2}


def test_the_range_of_a_time_leaves_a_tenth_out_at_either_end() -> None:
    times = np.append(np.linspace(1, 2, 10), 100)
    assert Seconds.of(times[::-1]) == Seconds(median=pytest.approx(1 + 5 / 9), low=pytest.approx(1 + 1 / 9), high=2)
    assert Seconds.of(np.array([3.0])) == Seconds(3, 3, 3)
    with pytest.raises(ValueError, match="at least one"):
        Seconds.of(np.zeros(0))
    costs = replace(made(), edit_s=np.array([1.0, 2.0, 3.0]))
    assert costs.parts()["edit_s"] == Seconds(2, pytest.approx(1.2), pytest.approx(2.8))


def test_no_damaged_byte_gives_another_error_or_other_numbers(tmp_path: Path) -> None:
    """Bytes that tell nothing, such as dates, may change."""
    costs = made()
    file = tmp_path / "costs.npz"
    costs.write(file)
    whole = file.read_bytes()
    refused = 0
    for place in range(0, len(whole), 7):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            again = FrameCosts.read(file)
        except StoreError:
            refused += 1
            continue
        np.testing.assert_array_equal(again.render_s, costs.render_s)
        np.testing.assert_array_equal(again.surface, costs.surface)
    assert refused > len(whole) / 7 / 2
