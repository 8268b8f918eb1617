"""`photonfarm store check --repair` sets damaged jobs aside, losing nothing, and they are rendered again."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import checked_store as stores
import numpy as np
import pytest

from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.model.quarantine import Quarantine

scene, outputs = stores.scene, stores.outputs
commit_all, checked, found, data = stores.commit_all, stores.checked, stores.found, stores.data
shard, flip, marker, recommitted = stores.shard, stores.flip, stores.marker, stores.recommitted


def test_repair_sets_damaged_jobs_aside_with_a_record_and_rendering_them_again_gives_the_clean_bytes(
    store: Store, scene: SceneStore
) -> None:
    clean, markers = data(scene), {job: marker(scene, job).read_bytes() for job in range(3)}
    damaged = shard(scene, "depth", 1)
    flip(damaged, 20)
    kept = damaged.read_bytes()
    report = checked(store, repair=True)
    assert report.exit_code == 7
    assert report.scenes[0].set_aside == ("job 1",)
    assert scene.missing_jobs() == [1]
    assert list(scene.folder.rglob("c.1.*")) == []

    quarantine = Path(store.root) / report.quarantine
    (record,) = [json.loads(p.read_text()) for p in quarantine.glob("job-*.json")]
    assert record["why"][0]["cause"] == "checksum"
    assert len(record["moved"]) == len([p for p in (quarantine / "scenes").rglob("*") if p.is_file()])
    assert (quarantine / damaged.relative_to(store.root)).read_bytes() == kept
    assert (quarantine / marker(scene, 1).relative_to(store.root)).read_bytes() == markers[1]

    commit_all(scene)
    assert data(scene) == clean
    assert found(checked(store, repair=True)) == {}


def test_a_reader_goes_on_through_a_repair_and_sees_the_samples_come_back(store: Store, scene: SceneStore) -> None:
    reader = SceneReader(store.root, scene.scene_id)
    assert reader.refresh().size == 10
    before = reader.read(4).radiance
    flip(shard(scene, "depth", 1), 20)
    checked(store, repair=True)
    reader.read(0)
    assert reader.refresh().size == 0
    assert reader.rows.tolist() == [0, 1, 2, 3, 8, 9]
    commit_all(scene)
    assert reader.refresh().tolist() == [4, 5, 6, 7]
    np.testing.assert_array_equal(reader.read(4).radiance, before)


def test_a_job_that_was_rendered_again_since_the_check_is_left_alone(store: Store, scene: SceneStore) -> None:
    seen = marker(scene, 1).read_bytes()
    marker(scene, 1).write_bytes(seen.replace(b'"core_s": 2.0', b'"core_s": 3.0'))
    assert not Quarantine(store.storage, "now").job(scene.name, 1, seen, [], [])
    assert scene.missing_jobs() == []


# A repair of this job places two records by a link each, and renames the marker and 23 files.
POINTS = [("link", 1, "before"), ("link", 2, "before"), ("link", 2, "after"), ("fsync", 3, "before")]
POINTS += [("rename", n, when) for n in (1, 2, 12, 24) for when in ("before", "after")]


def killed(function: str, count: int, when: str, work: Callable[[], object]) -> None:
    """Do some work in a process of its own, which is killed at a call of a function of `os`."""
    plain, left = getattr(os, function), iter(range(count - 1, -1, -1))

    def dying(*args: Any, **kwargs: Any) -> Any:
        last = next(left, -1) == 0
        if last and when == "before":
            os.kill(os.getpid(), signal.SIGKILL)
        result = plain(*args, **kwargs)
        if last:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    child = os.fork()
    if not child:
        setattr(os, function, dying)
        work()
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


@pytest.mark.parametrize("harm", ["flipped", "equal halves"])
@pytest.mark.parametrize("point", POINTS, ids=lambda point: "-".join(map(str, point)))
def test_a_repair_killed_at_any_point_loses_nothing_and_the_next_one_completes_it(
    store: Store, scene: SceneStore, point: tuple[str, int, str], harm: str
) -> None:
    """Whatever was moved, and whichever worker comes in between, the clean bytes are there in the end."""
    clean = data(scene)
    if harm == "flipped":
        flip(shard(scene, "radiance", 0), 20)
    else:
        recommitted(scene, 0, lambda given: given.radiance[1].__setitem__(1, given.radiance[1][0]))
    everything = {p.read_bytes() for p in scene.folder.rglob("*") if p.is_file()}
    files = [f"{scene.name}/{name}" for name in scene.marker(0)["files"]]
    content = marker(scene, 0).read_bytes()
    killed(*point, lambda: Quarantine(store.storage, "then").job(scene.name, 0, content, files, []))

    kept = {p.read_bytes() for p in Path(store.root).rglob("*") if p.is_file()}
    assert everything <= kept
    reader = SceneReader(store.root, scene.scene_id)
    reader.refresh()
    rows = reader.rows.tolist()
    assert rows in ([*range(10)], [*range(4, 10)])  # all of the job's, or none
    if 0 not in rows:
        assert [reader.read(row).row for row in rows] == rows
    commit_all(scene)
    if data(scene) != clean:
        assert checked(store, repair=True).exit_code == 7
        commit_all(scene)
        assert data(scene) == clean


def test_two_repairs_at_once_set_each_job_aside_once(store: Store, scene: SceneStore) -> None:
    clean = data(scene)
    for job in range(3):
        flip(shard(scene, "depth", job), 20)
    code = "import sys; from photonfarm.store import Store\n"
    code += "from photonfarm.store.check.check import check_store\n"
    code += "check_store(Store(sys.argv[1]), when='then', repair=True)"
    both = [subprocess.Popen([sys.executable, "-c", code, str(store.root)]) for _ in range(2)]
    assert [process.wait(60) for process in both] == [0, 0]
    assert scene.missing_jobs() == [0, 1, 2]
    assert len(list(Path(store.root).glob("quarantine/*/scenes/*/committed/*.json"))) == 3
    commit_all(scene)
    assert (data(scene), found(checked(store))) == (clean, {})


def test_a_damaged_job_stays_where_it_is_until_its_plan_is_whole(store: Store, scene: SceneStore) -> None:
    """Set aside, nobody could render it again; and all of it but a bit is good."""
    inputs = {path: path.read_bytes() for path in (scene.folder / "plans/000000").glob("sample_*/c.0*")}
    for path in inputs:
        flip(path, 3)
    flip(shard(scene, "depth", 1), 20)
    before = data(scene)
    report = checked(store, repair=True)
    assert (found(report), report.exit_code) == ({"plan-inputs": 4, "checksum": 1, "plan": 1, "left-in-place": 1}, 4)
    assert (report.scenes[0].set_aside, report.quarantine, data(scene) == before) == ((), None, True)
    assert marker(scene, 1).exists()
    for path, whole in inputs.items():
        path.write_bytes(whole)
    assert checked(store, repair=True).scenes[0].set_aside == ("job 1",)
