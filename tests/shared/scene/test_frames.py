"""The buffers of a camera path as a file."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from photonfarm.core.errors import StoreError
from photonfarm.core.records import Guides, Photons, arrays_of
from photonfarm.scene.camera_path import Frames
from photonfarm.scene.modification import Modification
from photonfarm.scene.view import View


def made(*, photons: bool) -> Frames:
    rng = np.random.default_rng(0)
    values = [rng.random((5, 3), np.float32) for _ in range(4)]
    traced = Photons(*values, np.array([0, 1, -1, 0, 1], np.int8)) if photons else None
    images = [rng.random((2, 4, 6, *more), np.float32) for more in ((), (3,), (3,))]
    moved = Modification(rng.random((3, 3), np.float32), np.array([True, False, True]))
    seen = [rng.random((2, count)) < 0.5 for count in (7, 5 if photons else 0)]
    views = tuple(View(*rng.random((2, 3), np.float32)) for _ in range(2))
    guides = Guides(*rng.random((len(fields(Guides)), 2, 4, 6), np.float32))
    return Frames("abc", moved, views, *images, *seen, traced, guides)


@pytest.mark.parametrize("photons", [True, False])
def test_frames_come_back_as_they_were_written(tmp_path: Path, photons: bool) -> None:
    frames = made(photons=photons)
    frames.write(tmp_path / "new/frames.npz")
    again = Frames.read(tmp_path / "new/frames.npz")
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["frames.npz"]
    assert (again.scene_id, len(again)) == ("abc", 2)
    np.testing.assert_array_equal(again.modification.vector, frames.modification.vector)
    for view, other in zip(again.views, frames.views, strict=True):
        np.testing.assert_array_equal(view.vector, other.vector)
    for name in ("depth", "albedo", "normal"):
        np.testing.assert_array_equal(getattr(again, name), getattr(frames, name))
        np.testing.assert_array_equal(getattr(again.buffers(1), name), getattr(frames, name)[1])
    for name, seen in (("points", frames.point_seen), ("photons", frames.photon_seen)):
        np.testing.assert_array_equal(getattr(again.visibility(1), name), seen[1])
        assert getattr(again.visibility(1), name).dtype == np.bool_
    for name, values in arrays_of(frames.guides).items():
        np.testing.assert_array_equal(getattr(again.guides, name), values)
        np.testing.assert_array_equal(getattr(again.guides_of(1), name), values[1])
    assert (again.photons is None) == (not photons)
    for field in fields(Photons) if photons else ():
        np.testing.assert_array_equal(getattr(again.photons, field.name), getattr(frames.photons, field.name))
        assert getattr(again.photons, field.name).dtype == getattr(frames.photons, field.name).dtype


def test_what_is_no_such_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("no archive")
    np.savez(tmp_path / "other.npz", depth=np.zeros(3))
    made(photons=False).write(tmp_path / "cut.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "cut.npz").read_bytes()[:-40])
    for name in ("text", "other", "cut"):
        with pytest.raises(StoreError, match=rf"{name}\.npz"):
            Frames.read(tmp_path / f"{name}.npz")
    with pytest.raises(StoreError):
        Frames.read(tmp_path / "missing.npz")
    with pytest.raises(StoreError):
        made(photons=False).write(tmp_path / "text.npz" / "below.npz")
