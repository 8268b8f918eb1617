"""What lights and objects change: which pixels are compared, and what the difference of two pairs of halves is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from moved_lights import Change, Image, Room, half_square, measured, mixed, page, same_surface
from photonfarm.shared.core.records import ViewBuffers
from photonfarm.shared.scene.modification import sample_modification
from photonfarm.shared.scene.spec import load_spec


def buffers(depth: float = 2.0) -> ViewBuffers:
    up = np.broadcast_to(np.array([0, 1, 0], np.float32), (16, 16, 3)).copy()
    return ViewBuffers(depth=np.full((16, 16), depth, np.float32), albedo=up, normal=up.copy())


def test_lights_or_objects_are_taken_from_the_other_configuration() -> None:
    spec = load_spec("room")
    count = len(spec.objects)
    assert 0 < count < len(spec.groups)
    first, second = (sample_modification(spec, 0, index) for index in range(2))
    lit, moved = (mixed(first, second, spec, lights=lights).vector for lights in (True, False))
    np.testing.assert_array_equal(lit, np.concatenate([first.vector[:count], second.vector[count:]]))
    np.testing.assert_array_equal(moved, np.concatenate([second.vector[:count], first.vector[count:]]))


def test_half_the_square_is_the_variance_between_images_without_the_halves_noise() -> None:
    rng, everywhere = np.random.default_rng(0), np.ones((16, 16), bool)

    def noisy(level: float) -> Image:
        return Image(level + rng.normal(0, 0.3, (2, 16, 16, 3)), buffers())

    drawn = rng.normal(0.5, 0.1, (400, 2))
    found = [half_square(noisy(first), noisy(second), everywhere) for first, second in drawn]
    assert np.mean(found) == pytest.approx(0.01, rel=0.15)


def test_only_pixels_that_show_the_same_are_compared() -> None:
    first, second = buffers(), buffers()
    second.depth[0] = 2.1
    second.normal[1] = (1, 0, 0)
    first.depth[2] = second.depth[2] = 0  # nothing is seen
    same = same_surface(first, second)
    assert not same[:3].any()
    assert same[3:].all()


@pytest.mark.slow
@pytest.mark.parametrize("moving", ["lights", "objects"])
def test_what_does_not_move_changes_nothing(tmp_path: Path, moving: str) -> None:
    """A room rendered once more as it was differs by noise alone, which the halves take out but for its scatter."""
    plain = load_spec("room")
    film = plain.film.model_copy(update={"width": 16, "height": 16})
    still: dict[str, Any] = {"objects" if moving == "lights" else "lights": ()}
    spec = plain.model_copy(update={"film": film, "points": 256, **still})
    file = tmp_path / "moving.json"
    file.write_text(spec.model_dump_json())
    room = measured(str(file), views=2, half_spp=32)
    moved, unmoved = (room.lights, room.objects) if moving == "lights" else (room.objects, room.lights)
    assert len(moved.whole) == len(unmoved.whole) == 2
    assert min(moved.whole) > 20 * max(np.abs(unmoved.whole)) > 0  # 0: noise that is not drawn anew
    assert min(moved.same_surface) > 0
    assert unmoved.same_surface == unmoved.whole


def test_the_page_has_a_line_for_each_room() -> None:
    text = page([Room("made-up", Change([0.1, 0.3], [0.01, 0.03]), Change([0.2, 0.2], [0.05]))], 2, 8)
    (line,) = (line.split(" | ") for line in text.splitlines() if line.startswith("| made-up "))
    assert [cell.split()[0] for cell in line[1:]] == ["0.20000", "0.02000", "0.20000", "0.05000"]
