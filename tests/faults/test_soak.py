"""A short soak, and that a soak tells what is wrong; the long one of the same kind is `make bench-soak`."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import soaking

from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.store import SceneStore, Store
from photonfarm.store.format.markers import marker_name

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the workers' children through /proc")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_farm_under_random_faults_commits_every_job_once_and_bit_for_bit(tmp_path: Path) -> None:
    wanted = soaking.Toll(kills=4, supervisor_kills=1, races=2, redis_kills=2, flushes=1, submitters=1)
    found = soaking.Soak(tmp_path, jobs=40, workers=3, pause_s=0.02, seed=1).run(
        wanted, pace_s=(0.1, 0.4), long_outage_s=2.0
    )
    assert found.differences == []
    assert [race for race in found.races if race.committed_by == race.worker] == []


def do_no_harm(scene: SceneStore, folder: Path) -> None:
    """Leave everything as it is, so that what is told below is due to what is done below."""


def flip_a_bit(scene: SceneStore, folder: Path) -> None:
    """Flip a bit in a base file, which the reader beside it does not read."""
    (file, *_) = sorted((scene.folder / "base").rglob("c.*"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def take_a_marker(scene: SceneStore, folder: Path) -> None:
    scene.storage.local(marker_name(scene.name, 1)).unlink()


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (do_no_harm, []),
        (flip_a_bit, ["is not what an undisturbed worker writes"]),
        (take_a_marker, ["job 1 is not committed", "and 2 are complete", "and 2 are shown by a reader that"]),
    ],
    ids=["nothing", "a bit flipped", "a marker gone"],
)
def test_a_soak_tells_every_difference(
    analytic: ModuleType,
    planned: Callable[..., SceneStore],
    tmp_path: Path,
    harm: Callable[[SceneStore, Path], None],
    told: list[str],
) -> None:
    scene = planned(2)
    journal = soaking.evidence.Journal(tmp_path / "journal")
    with soaking.evidence.Watcher(tmp_path / "store", scene.scene_id) as watcher:
        for job in scene.missing_jobs():
            ShardRenderer(Store(tmp_path / "store"), worker="first", load=analytic.AnalyticScene.load).render(
                scene.scene_id, job
            )
    watcher.check()
    harm(scene, tmp_path)
    found = soaking.evidence.differences(scene, tmp_path / "clean", journal, watcher)
    assert len(found) == len(told)
    assert all(sentence in difference for sentence, difference in zip(told, found, strict=True))
