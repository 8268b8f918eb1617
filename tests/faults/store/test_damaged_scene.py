"""A scene that is damaged holds up no other, whoever looks at it."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import StoreError
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.store import SceneStore, Store


@pytest.fixture
def scenes(analytic: ModuleType, tmp_path: Path) -> tuple[SceneStore, SceneStore]:
    """One with a bit of its plan flipped, and a whole one; of two jobs each."""
    store = Store(tmp_path / "store", create=True)
    specs = (analytic.small_spec(), analytic.small_spec(points=17))
    ids = [store.plan(spec, Request(modifications=4), shard_rows=2).scene_id for spec in specs]
    damaged, whole = (store.scene(scene_id) for scene_id in ids)
    path = damaged.folder / "plans/000000/view/c.0.0"
    path.write_bytes(bytes([path.read_bytes()[0] ^ 1]) + path.read_bytes()[1:])
    return damaged, whole


def test_a_worker_renders_what_is_whole_and_then_ends_with_the_error_of_what_is_not(
    analytic: ModuleType, scenes: tuple[SceneStore, SceneStore], redis_server: EmbeddedRedis, tmp_path: Path
) -> None:
    damaged, whole = scenes
    log = tmp_path / "log"
    worker = analytic.start_worker(
        tmp_path / "store", redis_server.url, analytic.command(0.0), log, until_complete=True, name="a"
    )
    try:
        assert worker.wait(60) == StoreError.exit_code
    finally:
        worker.kill()
    assert whole.missing_jobs() == []
    assert f"scene {damaged.scene_id} is passed over" in log.read_text()


def empty(marker: Path) -> None:
    marker.write_text("")


def become_a_folder(marker: Path) -> None:
    """A marker that cannot be read, whoever asks."""
    marker.unlink()
    marker.mkdir()


@pytest.mark.parametrize("harm", [empty, become_a_folder])
@pytest.mark.parametrize("as_json", [False, True])
def test_the_status_counts_markers_that_cannot_be_read_names_one_and_shows_the_rest(
    analytic: ModuleType, planned: Callable[..., SceneStore], harm: Callable[[Path], None], as_json: bool
) -> None:
    scene = planned(3)
    root = scene.folder.parent.parent
    for job in range(3):
        ShardRenderer(Store(root), worker="test", load=analytic.AnalyticScene.load).render(scene.scene_id, job)
    sizes = [sum(file["size"] for file in scene.marker(job)["files"].values()) for job in range(3)]
    for job in (0, 1):
        harm(scene.folder / f"committed/{job:012d}.json")
    words = ["status", "--store", str(root), "--redis", "redis://127.0.0.1:1/0", *(["--json"] if as_json else [])]
    result = CliRunner().invoke(umbrella, words)
    assert isinstance(result.exception, StoreError)
    for said in (str(result.exception), *([] if as_json else [result.stdout])):
        assert re.search(r"2 of 3 markers cannot be read, .*committed/000000000000\.json", said)
    if as_json:
        (about,) = json.loads(result.stdout)["scenes"]
        assert (about["error"], about["jobs_committed"], about["samples_complete"]) == (None, 3, 6)
        assert (about["size_bytes"], about["markers_unreadable"]) == (sizes[2], 2)
        assert "committed/000000000000.json" in about["marker_error"]
    else:
        assert re.search(rf"{scene.scene_id} +6/8 +3/4", result.stdout)


@pytest.mark.parametrize("as_json", [False, True])
def test_the_status_tells_the_damaged_scene_and_goes_on(
    scenes: tuple[SceneStore, SceneStore], tmp_path: Path, as_json: bool
) -> None:
    damaged, whole = scenes
    words = ["status", "--store", str(tmp_path / "store"), "--redis", "redis://127.0.0.1:1/0"]
    result = CliRunner().invoke(umbrella, [*words, *(["--json"] if as_json else [])])
    assert isinstance(result.exception, StoreError)
    assert "1 of 2 scenes" in str(result.exception)
    if as_json:
        errors = {scene["scene_id"]: scene["error"] for scene in json.loads(result.stdout)["scenes"]}
        assert errors[whole.scene_id] is None
        assert errors[damaged.scene_id] is not None
    else:
        assert f"{damaged.scene_id}: cannot be read" in result.stdout
        assert f"{whole.scene_id}  0/4" in result.stdout
