"""Top-up: more passes of what is planned, never one twice, and nothing but radiance rendered for them."""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
import store_samples as samples
from click.testing import CliRunner, Result

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SpecError
from photonfarm.core.keys import make_key
from photonfarm.plan.hold_out import are_held_out
from photonfarm.plan.request import MAX_SAMPLES, Request
from photonfarm.plan.top_up import TopUp, spp_per_pass
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import SceneReader, SceneStore, Store

SPP = 8  # of a pass of the small spec: two halves of half_spp = 4


@pytest.fixture
def scene(tmp_path: Path) -> SceneStore:
    """Plan 0: 6 views of 3 configurations, one pass each; plan 1: two more configurations; jobs of 4."""
    store = Store(tmp_path / "store", create=True)
    scene = store.scene(
        store.plan(samples.small_spec(), Request(modifications=3, views_per_modification=2), shard_rows=4).scene_id
    )
    scene.plan(Request(modifications=5, views_per_modification=2))
    return scene


def all_samples(scene: SceneStore) -> list:
    return [sample for job in range(scene.jobs()) for sample in scene.job_rows(job).samples]


def passes(scene: SceneStore) -> dict[int, list[int]]:
    """The pass numbers of each view row."""
    found: dict[int, list[int]] = {}
    for sample in all_samples(scene):
        found.setdefault(sample.view_row, []).append(sample.pass_)
    return {view: sorted(numbers) for view, numbers in found.items()}


def topped_up(scene: SceneStore, *where: str) -> set[int]:
    """The view rows that one more pass goes to."""
    before = passes(scene)
    scene.plan(TopUp.of(f"+{SPP}", where))
    return {view for view, numbers in passes(scene).items() if numbers != before[view]}


def test_every_view_gets_as_many_passes_more_as_the_samples_per_pixel_need_rounded_up(scene: SceneStore) -> None:
    assert spp_per_pass(scene.spec) == SPP
    assert [TopUp.of(spp).passes(scene.spec) for spp in ("+1", "+8", "+9", "64")] == [1, 1, 2, 8]
    result = scene.plan(TopUp.of("+17"))
    assert (result.plan, result.new, result.known, result.jobs) == (2, 30, 0, 8)
    assert list(passes(scene).values()) == [[0, 1, 2, 3]] * 10


def test_new_passes_refer_to_the_buffers_and_photons_that_are_there(scene: SceneStore) -> None:
    first = scene.jobs()
    inputs = {(s.view_row, s.modification_row) for s in all_samples(scene)}
    scene.plan(TopUp.of("+16"))
    new = [scene.job_rows(job) for job in range(first, scene.jobs())]
    assert {(s.view_row, s.modification_row) for rows in new for s in rows.samples} == inputs
    assert not any(rows.new_views or rows.new_modifications for rows in new)
    before = {path.parent.name for path in scene.folder.rglob("c.*.0*") if path.parent.parent.name == "000002"}
    samples.commit_all(scene)
    stored = {path.parent.name for path in scene.folder.rglob("c.*.0*") if path.parent.parent.name == "000002"}
    assert stored - before == {"radiance"}


def test_new_passes_have_keys_of_their_own_made_of_content(scene: SceneStore) -> None:
    scene.plan(TopUp.of("+16"))
    keys = [sample.key for sample in all_samples(scene)]
    assert len(set(keys)) == len(keys) == 30
    for job in range(scene.jobs()):
        rows = scene.job_rows(job)
        for s in rows.samples:
            modification, view = rows.modifications[s.modification_row], rows.views[s.view_row]
            assert s.key == make_key("sample", scene.spec.radiance_id, modification.vector, view.vector, s.pass_)


def test_a_total_counts_what_is_planned_and_repeating_it_plans_nothing(scene: SceneStore) -> None:
    scene.plan(TopUp.of("+8", ["plan=0"]))
    result = scene.plan(TopUp.of("24"))
    assert (result.new, result.known) == (6 * 1 + 4 * 2, 6 * 2 + 4 * 1)
    assert list(passes(scene).values()) == [[0, 1, 2]] * 10
    for spp in ("24", "17", "1"):
        again = scene.plan(TopUp.of(spp))
        assert (again.plan, again.new, again.known) == (None, 0, 10 * TopUp.of(spp).passes(scene.spec))


def test_a_request_for_as_many_passes_finds_those_of_a_top_up(scene: SceneStore) -> None:
    scene.plan(TopUp.of("+8"))
    result = scene.plan(Request(modifications=5, views_per_modification=2, passes=3))
    assert (result.new, result.known) == (10, 20)
    assert list(passes(scene).values()) == [[0, 1, 2]] * 10


def test_the_plan_tells_what_it_was_made_for(scene: SceneStore) -> None:
    wanted = TopUp.of("+8", ["views=first:2"])
    scene.plan(wanted)
    reopened = Store(scene.folder.parent.parent).scene(scene.scene_id).plans()
    assert [plan.request.kind for plan in reopened] == ["samples", "samples", "top-up"]
    assert reopened[-1].request == wanted
    attributes = json.loads((scene.folder / "plans/000002/zarr.json").read_text())["attributes"]
    assert attributes["request"] == {"kind": "top-up", "spp": 8, "adds": True, "where": ["views=first:2"]}


def test_racing_top_ups_plan_no_pass_twice_and_leave_none_out(scene: SceneStore) -> None:
    """Each adds three times and asks four times for one total: 1 + 2 · 3 passes, or that total."""
    code = """
import sys
from photonfarm.store import Store
from photonfarm.plan.top_up import TopUp
scene = Store(sys.argv[1]).scene(sys.argv[2])
sys.stdin.readline()
for spp in ("+8", "40", "+8", "40", "+8", "40", "40"):
    scene.plan(TopUp.of(spp))
"""
    command = [sys.executable, "-c", code, str(scene.folder.parent.parent), scene.scene_id]
    racers = [subprocess.Popen(command, stdin=subprocess.PIPE) for _ in range(2)]
    for racer in racers:
        racer.stdin.write(b"go\n")
        racer.stdin.flush()
    assert [racer.wait(120) for racer in racers] == [0, 0]
    for racer in racers:
        racer.stdin.close()
    found = passes(scene)
    assert {len(numbers) for numbers in found.values()} <= set(range(7, 12))
    assert all(numbers == list(range(len(numbers))) for numbers in found.values())
    assert len({sample.key for sample in all_samples(scene)}) == len(all_samples(scene))


# ---------------------------------------------------------------------------------------------------------- conditions


def test_the_first_views_are_those_planned_first_and_stay_so(scene: SceneStore) -> None:
    order = sorted(passes(scene))
    assert topped_up(scene, "views=first:3") == set(order[:3])
    scene.plan(Request(modifications=9))
    assert topped_up(scene, "views=first:3") == set(order[:3])
    assert topped_up(scene, "views=first:1", "plan=1") == {min(v for v in order if v >= scene.plans()[1].first_row)}


def test_a_plan_stands_for_the_views_that_it_brought(scene: SceneStore) -> None:
    new = {view for view in passes(scene) if view >= scene.plans()[1].first_row}
    assert topped_up(scene, "plan=1") == new
    with pytest.raises(SpecError):
        scene.plan(TopUp.of("+8", ["plan=2", "rows=0-1000"]))  # a top-up brings none
    with pytest.raises(SpecError):
        scene.plan(TopUp.of("+8", ["plan=7"]))


def test_rows_stand_for_the_views_that_they_show(scene: SceneStore) -> None:
    shown = {s.view_row for s in all_samples(scene) if 1 <= s.row <= 5}
    assert topped_up(scene, "rows=1-5") == shown
    last = all_samples(scene)[-1]
    assert topped_up(scene, f"rows={last.row}") == {last.view_row}


def test_a_key_selects_its_modification_or_view_also_by_its_beginning(scene: SceneStore) -> None:
    samples.commit_all(scene)
    reader = SceneReader(scene.folder.parent.parent, scene.scene_id)
    row = int(reader.refresh()[3])
    (sample,) = (s for s in all_samples(scene) if s.row == row)
    siblings = {s.view_row for s in all_samples(scene) if s.modification_row == sample.modification_row}
    assert topped_up(scene, f"modification={reader.modification_key(row).hex()}") == siblings
    assert topped_up(scene, f"view={reader.view_key(row).hex()}") == {sample.view_row}
    assert sample.view_row in topped_up(scene, f"view={reader.view_key(row).hex()[:3]}")


@pytest.mark.parametrize("objects", [None, []], ids=["of a dynamic scene configurations", "of a static scene views"])
def test_held_out_selects_what_training_keeps(tmp_path: Path, objects: list | None) -> None:
    store = Store(tmp_path / "store", create=True)
    spec = samples.small_spec() if objects is None else samples.small_spec(objects=objects)
    scene = store.scene(store.plan(spec, Request(modifications=40, views_per_modification=2)).scene_id)
    samples.commit_all(scene)
    reader = SceneReader(store.root, scene.scene_id)
    unit = reader.modification_key if spec.groups else reader.view_key
    view_of = {s.row: s.view_row for s in all_samples(scene)}
    for condition, share in (("held-out", 0.125), ("held-out=0.4", 0.4)):
        reader.refresh()
        rows = reader.rows.tolist()
        keys = reader.modification_keys(rows) if spec.groups else reader.view_keys(rows)
        assert keys == [unit(row) for row in rows]
        held_out = are_held_out(keys, share)
        expected = {view_of[row] for row, held in zip(rows, held_out, strict=True) if held}
        assert 0 < len(expected) < len(reader.rows)
        assert topped_up(scene, condition) == expected


@pytest.mark.parametrize("share", [1 / 3, 5e-324, 1 - 2**-53])
def test_every_share_that_python_writes_is_one(share: float) -> None:
    assert TopUp.of("+8", [f"held-out={share}"]).where == (f"held-out={share}",)


CONDITIONS = ["views=10", "views=first:0", "rows=a", "plan=-1", "", "held-out=1.0", "held-out=1e5", "held-out="]
KEYS = ["modification=XYZ", "view=", f"view={'a' * 33}"]


@pytest.mark.parametrize(
    ("condition", "allowed"),
    [*((condition, "views=first:N") for condition in CONDITIONS), *((condition, "content key") for condition in KEYS)],
)
def test_a_condition_or_key_that_is_none_is_refused_with_what_one_is(condition: str, allowed: str) -> None:
    with pytest.raises(SpecError, match=allowed):
        TopUp.of("+8", [condition])


@pytest.mark.parametrize("spp", ["", "-8", "8.5", "+0", "9999999999"])
def test_samples_per_pixel_that_are_none_are_refused(spp: str) -> None:
    with pytest.raises(SpecError):
        TopUp.of(spp)


def test_more_than_one_request_may_name_is_refused(scene: SceneStore) -> None:
    with pytest.raises(SpecError):
        scene.plan(TopUp.of(f"+{SPP * MAX_SAMPLES}"))
    assert len(scene.plans()) == 2


def test_nothing_planned_is_nothing_to_top_up(tmp_path: Path) -> None:
    store = Store(tmp_path / "store", create=True)
    with pytest.raises(SpecError, match="photonfarm submit"):
        store.add(samples.small_spec()).plan(TopUp.of("+8"))


# ---------------------------------------------------------------------------------------------------- the command line


@pytest.fixture
def room(tmp_path: Path) -> SceneStore:
    store = Store(tmp_path / "store", create=True)
    return store.scene(store.plan(load_spec("cornell"), Request(modifications=2)).scene_id)


def run(room: SceneStore, *arguments: str) -> Result:
    command = ["top-up", "cornell", *arguments, "--store", str(room.folder.parent.parent), "--no-queue"]
    return CliRunner().invoke(umbrella, command)


def test_the_command_plans_and_tells_what_was_rounded(room: SceneStore) -> None:
    per_pass = spp_per_pass(room.spec)
    result = run(room, "--spp", f"+{per_pass + 1}", "--where", "views=first:1")
    assert result.exit_code == 0, result.output
    assert "2 samples planned, 0 planned before, not queued" in result.stdout
    assert f"+{per_pass + 1} samples per pixel: 2 passes of {per_pass} each" in result.stderr
    assert sorted(Counter(s.view_row for s in all_samples(room)).values()) == [1, 3]


def test_the_command_as_json_and_dry_run_write_nothing(room: SceneStore) -> None:
    per_pass = spp_per_pass(room.spec)
    found = json.loads(run(room, "--spp", f"{3 * per_pass}", "--dry-run", "--json").stdout)
    assert (found["planned"], found["planned_before"], found["queued"], found["dry_run"]) == (4, 2, None, True)
    assert (found["passes"], found["spp_per_pass"], found["plan"]) == (3, per_pass, None)
    assert len(room.plans()) == 1
