"""Which views are named as the worst, and which pixels count as of one kind."""

from dataclasses import replace

import numpy as np
import pytest

from photonfarm.core.archives import Surface
from photonfarm.core.records import ViewBuffers
from photonfarm.trainer.report.views import write_caption as caption_of
from photonfarm.trainer.report.worst_cases import (
    ALL,
    MIRRORS,
    NEAR,
    HeldOutView,
    WorstCase,
    compute_squared_error,
    find_shadow_edges,
    find_thin_objects,
    find_worst_cases,
)

SIZE = 16


def view(
    row: int, error: float = 0.0, where: tuple[slice, slice] = (slice(None), slice(None)), **changes
) -> HeldOutView:
    """A grey wall at distance 5 under even light, which the network shows too bright by `error` in some pixels."""
    clean = np.full((SIZE, SIZE, 3), 0.25, np.float32)
    image = clean.copy()
    image[where] += error
    normal = np.zeros((SIZE, SIZE, 3), np.float32)
    normal[..., 2] = 1
    buffers = ViewBuffers(np.full((SIZE, SIZE), 5.0, np.float32), np.full((SIZE, SIZE, 3), 0.5, np.float32), normal)
    surface = np.full((SIZE, SIZE), Surface.DIFFUSE, np.uint8)
    return replace(HeldOutView(row, image, clean, clean.copy(), buffers, surface), **changes)


def mirror(pixels: int) -> np.ndarray:
    surface = np.full((SIZE, SIZE), Surface.DIFFUSE, np.uint8)
    surface[:pixels] = Surface.MIRROR
    return surface


def test_the_view_is_named_in_which_the_pixels_of_a_kind_cost_most_together() -> None:
    """A small mirror that is far off costs less than a large one that is off; what is wrong elsewhere is another's."""
    views = [
        view(1, 0.30, (slice(0, 1), slice(None)), surface=mirror(1)),
        view(2, 0.20, (slice(0, 8), slice(None)), surface=mirror(8)),
        view(3, 0.70, (slice(4, 16), slice(None)), surface=mirror(2)),
    ]
    found = {case.kind: case for case in find_worst_cases(views)}
    assert found["mirrors and clear glass"].row == 2
    assert found["mirrors and clear glass"].pixels == 0.5
    assert found["mirrors and clear glass"].mse == pytest.approx((0.45 ** (1 / 2.2) - 0.25 ** (1 / 2.2)) ** 2, rel=1e-4)
    assert found["all pixels"].row == 3


def test_one_view_may_be_the_worst_of_several_kinds_and_a_kind_that_no_view_shows_is_not_named() -> None:
    views = [view(1, 0.5, surface=mirror(8)), view(2, 0.1, surface=mirror(8))]
    found = find_worst_cases(views)
    assert [(case.kind, case.row) for case in found] == [("mirrors and clear glass", 1), ("all pixels", 1)]
    assert find_worst_cases([]) == []
    assert [case.kind for case in find_worst_cases([view(1, 0.3, surface=None)])] == ["all pixels"], "no renderer"


def test_the_view_of_median_error_is_not_called_the_worst_of_all_pixels() -> None:
    """Few views are shown of a small store, and the one of median error may be the only one, or the worst in a part."""
    worst = [WorstCase(MIRRORS, 3, 0.1, 0.2), WorstCase(ALL, 3, 1.0, 0.1), WorstCase(NEAR, 5, 0.1, 0.1)]
    assert caption_of(worst, 3, is_median=True) == "View of median error; worst view of mirrors and clear glass; row 3"
    assert caption_of(worst[1:], 3, is_median=True) == "View of median error; row 3"
    assert caption_of(worst, 3) == "Worst view of mirrors and clear glass and all pixels; row 3"
    assert (caption_of(worst, 5), caption_of(worst, 7)) == ("Worst view of near surfaces; row 5", "Row 7")


def test_the_noise_of_the_reference_is_no_error_on_average() -> None:
    rng = np.random.default_rng(1)
    clean = view(1)
    noisy = [
        replace(clean, half_a=a, half_b=b) for a, b in rng.uniform(0.2, 0.3, (400, 2, SIZE, SIZE, 3)).astype(np.float32)
    ]
    with_noise = np.mean([(compute_squared_error(replace(v, half_b=v.half_a))).mean() for v in noisy])
    without = np.array([compute_squared_error(v).mean() for v in noisy])
    assert with_noise > 1e-4
    assert abs(without.mean()) < 4 * without.std() / 20 + 2e-6  # what is left is the display's curve


@pytest.mark.parametrize(
    ("what", "expected"),
    [("nothing", 0), ("light", SIZE), ("texture", 0), ("edge", 0), ("corner", 0), ("mirror", 0)],
)
def test_a_step_of_light_is_a_shadow_s_edge_unless_something_else_steps_there(what: str, expected: int) -> None:
    """Left half lit, right half in shadow; each time another buffer steps at the same place."""
    wall = view(1)
    buffers = {name: getattr(wall.buffers, name).copy() for name in ("depth", "albedo", "normal")}
    shadow = np.full((SIZE, SIZE, 3), 0.4, np.float32)
    shadow[:, 8:] = 0.1
    if what == "texture":
        buffers["albedo"][:, 8:] = 0.125
    if what == "edge":
        buffers["depth"][:, 8:] = 9
    if what == "corner":
        buffers["normal"][:, 8:] = (1, 0, 0)
    if what == "mirror":
        buffers["albedo"][:] = 0
    image = wall.half_a if what == "nothing" else shadow
    stepped = replace(wall, half_a=image, half_b=image, buffers=ViewBuffers(**buffers))
    assert find_shadow_edges(stepped).sum() == expected


def test_a_step_in_one_half_of_the_reference_or_in_opposite_ways_is_noise() -> None:
    wall, shadow = view(1), np.full((SIZE, SIZE, 3), 0.4, np.float32)
    shadow[:, 8:] = 0.1
    assert find_shadow_edges(replace(wall, half_a=shadow)).sum() == 0
    assert find_shadow_edges(replace(wall, half_a=shadow, half_b=shadow[:, ::-1])).sum() == 0


def test_thin_objects_are_a_few_pixels_wide_and_nearer_than_both_sides() -> None:
    depth = np.full((SIZE, SIZE), 5.0, np.float32)
    depth[:, 4:6] = 2  # a leg
    depth[:, 9:] = 2  # a wall
    depth[12:14, :4] = 0  # a hole
    wanted = np.zeros((SIZE, SIZE), np.bool_)
    wanted[:, 4:6] = True
    np.testing.assert_array_equal(find_thin_objects(depth), wanted)
