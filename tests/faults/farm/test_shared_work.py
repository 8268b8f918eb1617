"""Workers that share the jobs of a store without Redis: killed, hung, failing, and at work on the same job."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import QueueError
from photonfarm.farm.submission import submit
from photonfarm.plan.request import Request
from photonfarm.queue.failures import read_kept_failures
from photonfarm.queue.job import TRIES
from photonfarm.renderer.worker.worker import run_worker
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import SceneStore, Store

Starter = Callable[..., subprocess.Popen[bytes]]

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the workers' children through /proc")


@pytest.fixture
def start(analytic: ModuleType, tmp_path: Path) -> Iterator[Starter]:
    """Starts a worker of a share, which is ended with the test and logs to a file of its name."""
    with contextlib.ExitStack() as stack:

        def started(scene: SceneStore, share: str, *child: object, **settings: object) -> subprocess.Popen[bytes]:
            name = f"worker-{share.partition('/')[0]}"
            process = stack.enter_context(
                analytic.start_worker(
                    scene.folder.parent.parent,
                    None,
                    analytic.command(*child),
                    tmp_path / f"{name}.log",
                    share=share,
                    name=name,
                    **settings,
                )
            )
            stack.callback(process.kill)
            return process

        yield started


def rendered_by(scene: SceneStore) -> dict[int, str]:
    return {job: scene.marker(job)["figures"]["worker"] for job in scene.committed_jobs()}


def test_a_worker_renders_its_share_first_and_then_that_of_one_who_has_not_come(
    planned: Callable[..., SceneStore], start: Starter, tmp_path: Path
) -> None:
    scene = planned(8)
    assert start(scene, "1/2", until_complete=True).wait(60) == 0
    assert scene.missing_jobs() == []
    committed = sorted((scene.folder / "committed").iterdir(), key=lambda marker: marker.stat().st_mtime_ns)
    assert [int(marker.stem) for marker in committed][:4] == [1, 3, 5, 7]
    assert "ended: 8 jobs done" in (tmp_path / "worker-1.log").read_text()


def test_a_job_that_another_worker_commits_meanwhile_is_given_up(
    analytic: ModuleType, planned: Callable[..., SceneStore], start: Starter, tmp_path: Path
) -> None:
    """Half an estimate takes two seconds, so a job takes eight, and is given up after its first sample."""
    from photonfarm.renderer.jobs.render import ShardRenderer

    scene = planned(2)
    quick = ShardRenderer(Store(scene.folder.parent.parent), worker="quick", load=analytic.AnalyticScene.load)
    quick.render(scene.scene_id, 1)
    running = start(scene, "0/1", 2.0, until_complete=True)
    analytic.wait_for(lambda: list((scene.folder.parent.parent / "tmp").glob("*.partial")))  # its first rows
    quick.render(scene.scene_id, 0)
    began = time.monotonic()
    assert running.wait(60) == 0
    assert time.monotonic() - began < 7
    assert rendered_by(scene) == {0: "quick", 1: "quick"}
    log = (tmp_path / "worker-0.log").read_text()
    assert "gives up" in log
    assert "failed" not in log


def test_jobs_that_fail_end_a_complete_run_and_are_not_tried_again_before_a_retry(
    analytic: ModuleType, planned: Callable[..., SceneStore], start: Starter, tmp_path: Path
) -> None:
    scene = planned(2)
    store = Store(scene.folder.parent.parent)
    for _ in range(2):  # the second worker finds what the first one has kept
        assert start(scene, "0/1", 0, "broken", until_complete=True).wait(60) == 7
    assert [failure.times for failure in read_kept_failures(store).values()] == [TRIES, TRIES]
    assert "photonfarm submit --retry" in (tmp_path / "worker-0.log").read_text()

    named = NamedSpec("analytic", analytic.small_spec(), None)
    request = Request(modifications=1, views_per_modification=2, passes=2)
    submit(named, store.root, None, request)
    assert start(scene, "0/1", until_complete=True).wait(60) == 7
    submit(named, store.root, None, request, retry=True)
    assert start(scene, "0/1", until_complete=True).wait(60) == 0
    assert scene.missing_jobs() == []


@pytest.mark.slow
def test_a_job_whose_process_is_killed_comes_last_and_is_tried_again(
    analytic: ModuleType, planned: Callable[..., SceneStore], start: Starter
) -> None:
    scene = planned(3)
    running = start(scene, "0/1", 0.2, until_complete=True)
    analytic.wait_for(lambda: list((scene.folder.parent.parent / "tmp").glob("*.partial")))  # its first rows
    os.kill(analytic.child_of(running), signal.SIGKILL)
    assert running.wait(60) == 0
    assert scene.missing_jobs() == []
    committed = sorted((scene.folder / "committed").iterdir(), key=lambda marker: marker.stat().st_mtime_ns)
    assert int(committed[-1].stem) == 0
    (failure,) = read_kept_failures(Store(scene.folder.parent.parent)).values()
    assert "SIGKILL" in failure.reason


@pytest.mark.parametrize(
    "arguments",
    [
        ["--share", "2/2"],
        ["--share", "0/2", "--job", "1", "--scene", "room"],
        ["--share", "0/2", "--check"],
        ["--share", "0/2", "--ahead", "4"],
        ["--share", "0/2", "--scene", "room", "room"],
        ["room"],
    ],
)
def test_what_does_not_go_with_a_share_is_wrong_usage(arguments: list[str]) -> None:
    assert CliRunner().invoke(umbrella, ["work", *arguments]).exit_code == 2


def test_a_worker_has_a_redis_or_a_share(store: Store) -> None:
    with pytest.raises(QueueError):
        run_worker(store.root)
