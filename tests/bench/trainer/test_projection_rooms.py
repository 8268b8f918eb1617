"""The trainer's projection against the brute-force oracle, in the built-in room, and in the real ones that are here."""

import pytest

from bench.trainer import projection
from bench.trainer.projection import RoomCounts
from bench.trainer.projection_rooms import Counts, LoadedRoom
from photonfarm.core.errors import SpecError
from photonfarm.renderer.scene import backend

SIZE, VIEWS, POINTS, JUDGED = 256, 4, 4096, 450


@pytest.fixture(scope="module", params=["room", *projection.TARGET_ROOMS])
def found(request: pytest.FixtureRequest) -> RoomCounts:
    """What was counted in a room over a few views."""
    backend.load(threads=1)
    try:
        room = LoadedRoom.load(request.param, POINTS, SIZE)
    except SpecError as error:
        pytest.skip(str(error))
    counted = RoomCounts(request.param, len(room.geometry.faces))
    for viewed in room.views(VIEWS, JUDGED):
        counted.add(viewed, room)
    return counted


def test_what_is_stored_as_seen_is_what_the_oracle_sees(found: RoomCounts) -> None:
    assert found.judged > 1000
    exact = found.counts["exact"]
    assert 300 < exact.seen < 0.9 * found.judged
    assert exact.recall >= 0.999
    assert exact.leak <= 0.001


def test_points_of_moved_objects_are_seen_where_the_edited_scene_has_them(found: RoomCounts) -> None:
    moved = found.counts["moved"]
    assert moved.seen > 10
    assert moved.recall >= 0.99
    assert moved.leak <= 0.01


def test_window_depth_keeps_what_is_seen_and_much_that_is_not(found: RoomCounts) -> None:
    assert found.counts["window"].recall >= 0.985
    assert found.counts["window"].leak >= 0.1


def test_the_surface_s_plane_lets_a_fifth_at_most_pass_of_what_window_depth_does(found: RoomCounts) -> None:
    assert found.counts["surface"].recall >= 0.97
    assert found.counts["surface"].leak <= min(0.07, 0.2 * found.counts["window"].leak)


def test_the_verdict_says_by_which_rules_the_target_is_met() -> None:
    good, bad = Counts(1000, 1000, 991), Counts(1000, 1050, 995)
    counts = dict.fromkeys(projection.RULES, bad) | {"exact": good}
    rooms = [RoomCounts("veach-ajar", 9, counts=counts), RoomCounts("kitchen", 9, counts=counts)]
    told = projection.verdict(rooms)
    assert "- **by `exact`, the default, in 1 of 1**: recall 99.1% … 99.1%, leak 0.9% … 0.9%" in told
    assert "- by `window` in 0 of 1: recall 99.5% … 99.5%, leak 5.2% … 5.2%" in told
    assert "kitchen" not in told
    assert "None of the target" in projection.verdict(rooms[1:])


def test_recall_and_leak_are_shares_of_what_is_seen_and_of_what_is_kept() -> None:
    counts = Counts(seen=4, kept=4, both=3)
    assert (counts.recall, counts.leak) == (0.75, 0.25)
    assert counts + counts == Counts(8, 8, 6)
    assert (Counts().recall, Counts().leak) == (1.0, 0.0)
