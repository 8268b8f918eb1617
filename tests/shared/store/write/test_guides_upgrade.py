"""`photonfarm store upgrade` asks for the guides that older scenes lack, once, and says how far it is."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import store_samples as samples
from click.testing import CliRunner
from older_store import REQUEST, files

from photonfarm.shared.cli.main import umbrella
from photonfarm.shared.core.errors import QueueError, SpecError, StoreError
from photonfarm.shared.farm.redis_server import EmbeddedRedis
from photonfarm.shared.farm.submission import submit
from photonfarm.shared.farm.upgrade import upgrade
from photonfarm.shared.queue import connect, open_queue
from photonfarm.shared.queue.entries import queued_names
from photonfarm.shared.scene.spec import GuideSpec
from photonfarm.shared.scene.spec_loading import NamedSpec
from photonfarm.shared.store import SceneStore, Store, store_status


@pytest.fixture
def store(older: Path, tmp_path: Path) -> Store:
    """A copy of it."""
    shutil.copytree(older, tmp_path / "store")
    return Store(tmp_path / "store")


@pytest.fixture
def scene(store: Store) -> SceneStore:
    return store.scenes()[0]


def run(store: Store, *arguments: str, verb: tuple[str, ...] = ("store", "upgrade", "--no-queue")) -> Any:
    return CliRunner().invoke(umbrella, [*verb, "--store", str(store.root), *arguments], prog_name="photonfarm")


def told(store: Store, *arguments: str) -> dict[str, Any]:
    """What `store upgrade --json` says."""
    result = run(store, "--json", *arguments)
    assert result.exit_code == 0, result.output
    return dict(json.loads(result.stdout))


def test_an_upgrade_asks_once_and_says_how_far_it_is_whenever_it_is_repeated(store: Store, scene: SceneStore) -> None:
    before = files(scene)
    said = run(store).stdout
    assert scene.scene_id in said
    assert "10 of 10 views" in said
    assert "3 jobs" in said
    assert f"photonfarm work --until-complete --store {store.root}" in said
    samples.commit_guides(scene, 1)
    (again,) = told(store)["scenes"]
    assert (again["asked"], again["views_lacking"], again["views"], again["jobs_lacking"]) == (False, 6, 10, 2)
    for job in (0, 2):
        samples.commit_guides(scene, job)
    assert run(store).stdout.count("0 of 10 views lack them: 0 jobs to render") == 1
    assert "go on with" not in run(store).stdout
    assert files(scene) == before


def test_the_bytes_that_are_told_are_those_that_are_stored_and_a_bound(store: Store, scene: SceneStore) -> None:
    (before,) = told(store)["scenes"]
    assert before["bytes_per_sample"] == sum(p.stat().st_size for p in scene.folder.glob("plans/*/*/c.*.0*")
                                             if p.parent.name not in INPUTS) / 10  # fmt: skip
    for job in range(3):
        samples.commit_guides(scene, job)
    (after,) = told(store)["scenes"]
    assert {**before, "asked": False, "views_lacking": 0, "jobs_lacking": 0} == after
    status = store_status(store)[0]
    assert 0.4 * after["guide_bytes_per_sample"] < status.guide_bytes / 10 <= after["guide_bytes_per_sample"]
    noise = np.random.default_rng(0).standard_normal(8 * 8 * 3)  # does not compress
    assert len(noise) * 4 < after["guide_bytes_per_sample"]


INPUTS = ("modification", "view", "sample_modification", "sample_view", "sample_pass", "sample_key")


def test_a_dry_run_says_the_same_and_writes_nothing(store: Store, scene: SceneStore) -> None:
    before = set(Path(store.root).rglob("*"))
    said = run(store, "--dry-run", "--light-samples", "5").stdout
    assert "guides would be asked for, with 5 light samples" in said
    assert "10 of 10 views lack them: 3 jobs to render" in said
    assert set(Path(store.root).rglob("*")) == before
    (dry,) = told(store, "--dry-run")["scenes"]
    (done,) = told(store)["scenes"]
    assert dry == done


def test_settings_that_are_there_win(store: Store, scene: SceneStore) -> None:
    scene.guides.want(GuideSpec(light_samples=1))
    (about,) = told(store, "--light-samples", "9")["scenes"]
    assert (about["asked"], about["light_samples"]) == (False, 1)
    assert scene.guides.settings() == GuideSpec(light_samples=1)


def test_one_scene_is_upgraded_by_its_name_and_the_others_are_not(store: Store, scene: SceneStore) -> None:
    other = store.add(samples.small_spec(name="other", points=7))
    (about,) = told(store, "--scene", "other", "--light-samples", "0")["scenes"]
    assert (about["scene_id"], about["bytes_per_sample"], about["views"]) == (other.scene_id, None, 0)
    assert other.guides.settings() == GuideSpec(light_samples=0)
    assert scene.guides.settings() is None


def test_a_damaged_scene_is_told_and_the_others_are_upgraded(store: Store, scene: SceneStore) -> None:
    other = store.add(samples.small_spec(name="other", points=7))
    (other.folder / "spec.json").write_text("{")
    result = run(Store(store.root))
    assert isinstance(result.exception, StoreError)
    assert result.exception.exit_code == 4
    assert other.scene_id in str(result.exception)
    assert Store(store.root).scene(scene.scene_id).guides.settings() == GuideSpec()


def test_a_number_of_light_samples_that_cannot_be_is_refused(store: Store, scene: SceneStore) -> None:
    assert run(store, "--light-samples", "65").exit_code == 2
    with pytest.raises(SpecError):
        upgrade(store.root, None, light_samples=-1)
    assert scene.guides.settings() is None


def test_what_lacks_guides_is_queued_once(store: Store, scene: SceneStore, common_redis: EmbeddedRedis) -> None:
    with connect(common_redis.url) as connection:
        connection.flushall()
        assert upgrade(store.root, common_redis.url).queued == 3
        assert upgrade(store.root, common_redis.url, scene="small").queued == 0
        assert queued_names(open_queue(connection)) == [f"{scene.scene_id}-{job}" for job in range(3)]


def test_without_redis_guides_are_asked_for_and_the_error_says_so(store: Store, scene: SceneStore) -> None:
    with pytest.raises(QueueError, match="--no-queue"):
        upgrade(store.root, "redis://localhost:1/0")
    assert scene.guides.settings() == GuideSpec()


def test_submitting_an_older_scene_again_asks_for_guides_too(store: Store, scene: SceneStore, tmp_path: Path) -> None:
    (tmp_path / "small.json").write_text(samples.small_spec(guides={"light_samples": 4}).model_dump_json())
    result = submit(NamedSpec.load(str(tmp_path / "small.json")), store.root, None, REQUEST)
    assert (result.planned, result.planned_before) == (0, 10)
    assert scene.guides.settings() == GuideSpec(light_samples=4)


def test_status_tells_how_many_views_have_guides_and_counts_what_they_take(store: Store, scene: SceneStore) -> None:
    def of(*arguments: str) -> str:
        result = run(store, "--redis", "redis://localhost:1/0", *arguments, verb=("status",))
        assert result.exit_code == 0, result.output
        return str(result.stdout)

    def about() -> dict[str, Any]:
        (scene_about,) = json.loads(of("--json"))["scenes"]
        return dict(scene_about)

    before = about()
    assert (before["views_planned"], before["views_guided"], before["guide_bytes"]) == (10, None, 0)
    assert "guides" not in of()
    scene.guides.want(GuideSpec())
    samples.commit_guides(scene, 1)
    after = about()
    held = sum(path.stat().st_size for path in (scene.folder / "guides").rglob("c.1.*"))
    assert (after["views_guided"], after["guide_jobs"], after["guide_bytes"]) == (4, 1, held)
    assert after["size_bytes"] == before["size_bytes"] + held
    assert after["core_s"] == before["core_s"] + samples.FIGURES.core_s
    assert re.search(r"small +[0-9a-f]{32} +10/10 +3/3 +4/10 views", of())


def test_the_verb_needs_neither_mitsuba_nor_torch_nor_redis_for_its_help() -> None:
    code = (
        "import sys; from photonfarm.shared.cli.main import main\n"
        "try: main(['store', 'upgrade', '--help'])\n"
        "except SystemExit: pass\n"
        "assert not {'mitsuba', 'drjit', 'torch', 'zarr', 'rq'} & sys.modules.keys(), sys.modules.keys()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--light-samples" in done.stdout
