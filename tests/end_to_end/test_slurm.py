"""`photonfarm slurm` on a real SLURM of two nodes. It takes a quarter of an hour, so it waits to be asked:

make test-slurm
"""

import json
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import slurm_cluster
from slurm_cluster import Cluster

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.store import SceneStore, Store

pytestmark = [
    pytest.mark.skipif(
        os.environ.get("PHOTONFARM_TEST_SLURM") != "1", reason="starts a SLURM; run by: make test-slurm"
    ),
    pytest.mark.skipif(bool(slurm_cluster.lacking()), reason=slurm_cluster.lacking() or "SLURM is installed"),
    pytest.mark.timeout(1500),
]

BEGAN = time.monotonic()


def say(line: str) -> None:
    """Say what happens, for the log of the test."""
    print(f"{time.monotonic() - BEGAN:6.0f} s  {line}", flush=True)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A cluster that the tests of this module share."""
    with slurm_cluster.running(tmp_path_factory.mktemp("cluster")) as found:
        say(f"{found.run('sbatch', '--version')}, nodes {found.run('sinfo', '--noheader', '--format', '%P %N %t')!r}")
        yield found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder whose name has to be quoted, with the spec of a tiny room in it."""
    folder = tmp_path / "a farm"
    folder.mkdir()
    import photonfarm.scene

    text = (Path(photonfarm.scene.__file__).parent / "specs/cornell.toml").read_text()
    for key, value in {"width": 32, "height": 32, "points": 512}.items():
        text, found = re.subn(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
        assert found == 1, key
    (folder / "small.toml").write_text(text)
    return folder


Launch = Callable[..., dict[str, Any]]


@pytest.fixture
def launch(photonfarm_in: Any, folder: Path, cluster: Cluster) -> Iterator[Launch]:
    """Runs `photonfarm slurm` there; its jobs are cancelled with the test."""
    started: list[str] = []

    def run(*options: str) -> dict[str, Any]:
        environment = cluster.environment | {"PHOTONFARM_REDIS_URL": ""}
        done = photonfarm_in(folder)("slurm", "small.toml", *options, "--json", **environment)
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        started.extend(job for job in (found["workers"], found["trainer"]) if job)
        return found

    yield run
    for job in started:
        cluster.run("scancel", job)
    wait_for(lambda: not any(cluster.states(job) for job in started), 60)


def wait_for(condition: Callable[[], object], seconds: float = 300) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.5)


def scene_of(folder: Path) -> SceneStore:
    (scene,) = Store(folder / "store").scenes()
    return scene


def logs(folder: Path) -> str:
    return "\n".join(f"--- {log.name}\n{log.read_text()}" for log in sorted((folder / "slurm").glob("*.log")))


class Markers:
    """The markers as each was first seen: none may change, or a job was committed twice."""

    def __init__(self, scene: SceneStore) -> None:
        self._folder = scene.folder / "committed"
        self._seen: dict[str, tuple[int, bytes]] = {}

    def look(self) -> int:
        """The number of markers; fails if one has been replaced."""
        for marker in sorted(self._folder.glob("*.json")) if self._folder.exists() else ():
            now = (marker.stat().st_ino, marker.read_bytes())
            assert self._seen.setdefault(marker.name, now) == now, f"{marker} was replaced"
        return len(self._seen)

    def workers(self) -> dict[str, int]:
        """The number of jobs that each worker committed."""
        names = [json.loads(content)["figures"]["worker"] for _, content in self._seen.values()]
        return {name: names.count(name) for name in sorted(set(names))}


def assert_complete(photonfarm_in: Any, folder: Path, markers: Markers, jobs: int) -> None:
    assert markers.look() == jobs
    assert scene_of(folder).missing_jobs() == []
    checked = photonfarm_in(folder)("store", "check")
    assert checked.returncode == 0, checked.stdout + checked.stderr
    say(f"complete: {jobs} jobs, each committed once; store check: {checked.stdout.splitlines()[-1]}")
    say(f"committed by {markers.workers()}")
    said = logs(folder)
    given_up = said.count("which another worker has committed") + said.count("was committed by another worker")
    say(f"rendered by a second worker meanwhile, in vain: {given_up}")


@pytest.mark.parametrize("with_redis", [False, True], ids=["store", "redis"])
def test_an_array_of_four_loses_a_task_and_a_node_and_completes_the_plan_once(
    photonfarm_in: Any, folder: Path, launch: Launch, cluster: Cluster, with_redis: bool
) -> None:
    jobs, rows = 1500, 6  # more than four workers commit before SLURM gives up the node, after 40 s
    say(f"--- array of 4, {'with Redis' if with_redis else 'without Redis'}")
    with ExitStack() as stack:
        named = ("--redis", stack.enter_context(EmbeddedRedis(folder / "redis")).url) if with_redis else ()
        request = ("--modifications", str(jobs * rows), "--views", "1", "--shard-rows", str(rows))
        started = launch(*request, "--workers", "4", "--time", "30", *named)
        array, scene = started["workers"], scene_of(folder)
        say(f"array {array} of {jobs} jobs submitted")
        tasks = [f"{array}_{number}" for number in range(4)]
        wait_for(lambda: cluster.states(array) == dict.fromkeys(tasks, "R"))
        nodes = {task: cluster.about(task)["NodeList"] for task in tasks}
        assert sorted(nodes.values()) == ["n1", "n1", "n2", "n2"]
        markers = Markers(scene)
        wait_for(lambda: markers.look() >= 8)
        say(f"{markers.look()} jobs committed by {markers.workers()}; tasks on {nodes}")

        high = cluster.run(
            "sbatch", "--parsable", "--partition=high", "--nodelist=n1", "--output=/dev/null", "--wrap", "sleep 20"
        )
        wait_for(lambda: [task for task, state in cluster.states(array).items() if state == "PD"], 60)
        (preempted,) = [task for task, state in cluster.states(array).items() if state == "PD"]
        say(f"job {high} of partition high preempted {preempted}: {cluster.about(preempted)['Reason']}")
        cluster.kill_node("n2")
        returned = stack.enter_context(ExitStack())
        returned.callback(cluster.start_node, "n2")  # also for the next test, if this one fails
        say(f"slurmd of n2 killed; {markers.look()} jobs committed")
        lost = [task for task, node in nodes.items() if node == "n2"]
        wait_for(lambda: all(cluster.about(task)["JobState"] != "RUNNING" for task in lost), 120)
        say(
            f"n2 is {cluster.run('sinfo', '--noheader', '--nodes', 'n2', '--format', '%T')}; {lost} requeued; "
            f"{markers.look()} jobs committed"
        )
        assert markers.look() < jobs, "the plan was complete before the node was lost"
        wait_for(lambda: markers.look() == jobs, 900)
        assert_complete(photonfarm_in, folder, markers, jobs)
        returned.close()
        wait_for(lambda: not cluster.states(array), 400)
        restarts = {task: int(cluster.about(task)["Restarts"]) for task in tasks}
        states = {task: cluster.about(task)["JobState"] for task in tasks}
        say(f"restarts {restarts}, states {states}")
        assert [restarts[task] for task in (preempted, *lost)] == [1, 1, 1]
        assert set(states.values()) == {"COMPLETED"}
        assert markers.look() == jobs
    assert "stopping; a job in hand" in (folder / f"slurm/worker-{preempted}.log").read_text()


def test_tasks_that_their_time_limit_ends_go_on_in_their_next_turn(
    photonfarm_in: Any, folder: Path, launch: Launch, cluster: Cluster
) -> None:
    """Two tasks, as one of an array has the array's own job id."""
    say("--- time limit of 3 minutes")
    started = launch("--modifications", "60000", "--views", "1", "--shard-rows", "6", "--workers", "2", "--time", "3")
    array, back = started["workers"], "the task is back in the queue"
    tasks = [f"{array}_{number}" for number in range(2)]
    files = [folder / "slurm" / f"worker-{task}.log" for task in tasks]
    wait_for(lambda: all(log.exists() and back in log.read_text() for log in files), 240)
    markers = Markers(scene_of(folder))
    first = markers.look()
    say(f"told near their limit, with {first} jobs committed; now {cluster.states(array)}")
    assert first > 0
    wait_for(lambda: cluster.states(array) == dict.fromkeys(tasks, "R"), 240)
    wait_for(lambda: markers.look() > first, 120)
    assert [int(cluster.about(task)["Restarts"]) for task in tasks] == [1, 1]
    say(f"go on: {markers.look()} jobs committed")

    cluster.run("scancel", array)
    wait_for(lambda: not cluster.states(array), 60)
    say("cancelled by their user, and not put back")
    assert [log.read_text().count(back) for log in files] == [1, 1]
    assert not list((folder / "store").glob("failures/*"))


def test_the_trainer_begins_with_the_first_worker_and_trains_on_what_arrives(
    folder: Path, launch: Launch, cluster: Cluster
) -> None:
    say("--- two workers and the trainer")
    request = ("--modifications", "96", "--views", "1", "--shard-rows", "6", "--workers", "2", "--time", "30")
    started = launch(*request, "--train", "--train-steps", "20")
    trainer = started["trainer"]
    wait_for(lambda: not cluster.states(trainer) and not cluster.states(started["workers"]), 600)
    about, first = cluster.about(trainer), cluster.about(f"{started['workers']}_0")
    say(f"trainer {trainer}: {about['JobState']}, began {about['StartTime']}; worker 0 began {first['StartTime']}")
    assert about["JobState"] == "COMPLETED", logs(folder)
    assert first["StartTime"] <= about["StartTime"]
    assert (folder / "run/checkpoint.safetensors").exists()
    assert scene_of(folder).missing_jobs() == []
