"""What `up` and `submit` say of a hold-out before anything is rendered is what the trainer does with it."""

import contextlib
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from photonfarm.core.errors import SpecError
from photonfarm.farm.hold_out_checks import check_hold_out, choose_hold_out
from photonfarm.farm.submission import submit
from photonfarm.plan.chosen import Chosen
from photonfarm.plan.hold_out import HOLD_OUT, rows_held_out
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import PlannedViews
from photonfarm.scene.arrangement import Shot
from photonfarm.scene.spec_loading import NamedSpec, load_spec
from photonfarm.store import SceneReader, Store
from photonfarm.store.model.plans import content


@pytest.mark.parametrize("spec", ["room", "cornell"])
@pytest.mark.parametrize("count", [2, 3, 5, 8, 13])
def test_enough_of_a_small_plan_is_held_out(tmp_path: Path, spec: str, count: int) -> None:
    loaded, wanted = load_spec(spec), Request(modifications=count)
    share = choose_hold_out(loaded, tmp_path / "none", wanted)
    check_hold_out(loaded, tmp_path / "none", share, wanted)
    with contextlib.suppress(SpecError):
        check_hold_out(loaded, tmp_path / "none", HOLD_OUT, wanted)
        assert share == HOLD_OUT, "the default stays where it does"


def test_numbers_that_a_refused_hold_out_names_are_enough_and_what_is_planned_counts(tmp_path: Path) -> None:
    room, none = load_spec("room"), tmp_path / "none"
    with pytest.raises(SpecError) as refused:
        check_hold_out(room, none, HOLD_OUT, Request(modifications=3))
    share, count = re.findall(r"--hold-out (\S+) .* --modifications (\d+)", str(refused.value))[0]
    check_hold_out(room, none, float(share), Request(modifications=3))
    check_hold_out(room, none, HOLD_OUT, Request(modifications=int(count)))
    for wanted in (Request(modifications=int(count) - 1), Request(seed=1, modifications=1)):
        with pytest.raises(SpecError):
            check_hold_out(room, none, HOLD_OUT, wanted)
    submit(NamedSpec.load("room"), tmp_path / "store", None, Request(modifications=64))
    check_hold_out(room, tmp_path / "store", HOLD_OUT, Request(seed=1, modifications=1))


@pytest.mark.parametrize(("name", "held_out", "enough"), [("room", 39, 4), ("cornell", 5, 8)])
def test_what_a_person_chose_is_no_hold_out_and_takes_none_away(
    tmp_path: Path, name: str, held_out: int, enough: int
) -> None:
    """The seed of one that is held out alone, and the number of those of seed 0 of which one is."""
    spec = load_spec(name)
    shots = [Shot(camera=(x, 1, 1), look_at=(0, 1, 0)) for x in (0.1, 0.2, 0.3)]
    shots += [Shot(move={"sofa": (0, 0, x)}) for x in np.linspace(0, 0.1, 20) if spec.groups]
    store = Store(tmp_path / "store", create=True)
    scene_id = store.plan(spec, Chosen(shots=tuple(shots))).scene_id
    with pytest.raises(SpecError, match="planned: one to train on"):
        choose_hold_out(spec, store.root, Request(modifications=1))
    with pytest.raises(SpecError, match="all are held out"):
        check_hold_out(spec, tmp_path / "none", HOLD_OUT, Request(seed=held_out))
    check_hold_out(spec, store.root, HOLD_OUT, Request(seed=held_out))
    check_hold_out(spec, tmp_path / "none", HOLD_OUT, wanted := Request(modifications=enough))
    check_hold_out(spec, store.root, HOLD_OUT, wanted)
    store.plan(spec, wanted)
    views = PlannedViews.of(spec, content(store.scene(scene_id).plans()))
    assert any(rows_held_out(views, np.arange(len(views.view_row)), HOLD_OUT))


@pytest.mark.parametrize("spec", ["room", "cornell"])
def test_what_is_checked_is_the_hold_out_that_the_trainer_makes(
    analytic: ModuleType, tmp_path: Path, spec: str
) -> None:
    """Configurations of `room`, views of the static `cornell`; three of them, so that one side is empty often."""
    request, root = Request(modifications=3, passes=2), tmp_path / "store"
    scene_id = submit(NamedSpec.load(spec), root, None, request).scene_id
    analytic.render_missing(Store(root), scene_id, analytic.AnalyticScene.load)
    source = SceneReader(root, scene_id)
    rows = source.refresh()
    assert len(rows) == 6
    found = set()
    for share in (0.02, *np.linspace(0.1, 0.9, 5), 0.998):
        sides = set(rows_held_out(source, rows.tolist(), share))
        for store in (root, tmp_path / "none"):
            if len(sides) == 2:
                check_hold_out(load_spec(spec), store, share, request)
            else:
                with pytest.raises(SpecError, match="all are" if sides == {True} else "none is"):
                    check_hold_out(load_spec(spec), store, share, request)
        found.add(frozenset(sides))
    assert len(found) == 3, "each way of splitting was met"
