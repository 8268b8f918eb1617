"""Bytes that are not what was committed are never returned, and the error names the file."""

from pathlib import Path

import pytest
import store_samples as samples

from photonfarm.core.errors import CorruptError
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, SceneStore, Store


@pytest.fixture
def scene(tmp_path: Path) -> SceneStore:
    store = Store(tmp_path / "store", create=True)
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=4), shard_rows=4).scene_id)
    given = samples.outputs(scene, 0)
    given.radiance[3][0, 0, 0, 0] = 1e9  # one row in radiance_wide
    samples.commit(scene, 0, given)
    scene.write_base(*samples.base())
    return scene


def read_everything(scene: SceneStore) -> None:
    reader = SceneReader(scene.folder.parent.parent, scene.scene_id)
    for row in reader.refresh():
        reader.read(int(row), guides=True)
        reader.read_photons(int(row))
    reader.base()


def assert_is_found(scene: SceneStore, named: str) -> None:
    with pytest.raises(CorruptError, match=named):
        read_everything(scene)


def shard(scene: SceneStore, name: str) -> Path:
    (path,) = (scene.folder / "plans/000000" / name).glob("c.0*")
    return path


OUTPUTS = (
    "radiance",
    "radiance_wide",
    "depth",
    "albedo",
    "normal",
    "direct",
    "point_light",
    "photon_position",
    "photon_power",
    "photon_bounce",
)


@pytest.mark.parametrize("name", OUTPUTS)
def test_any_flipped_bit_of_a_shard_is_found(scene: SceneStore, name: str) -> None:
    path = shard(scene, name)
    whole = path.read_bytes()
    for place in range(0, len(whole), max(1, len(whole) // 40)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        assert_is_found(scene, rf"{name}/c\.0")
    path.write_bytes(whole)
    read_everything(scene)


@pytest.mark.parametrize("keep", [0, 3, 0.5, -1])
def test_a_cut_shard_is_found(scene: SceneStore, keep: float) -> None:
    path = shard(scene, "radiance")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep * len(whole)) if keep == 0.5 else int(keep)])
    assert_is_found(scene, str(path))


@pytest.mark.parametrize("name", ["radiance", "depth", "photon_power"])
def test_a_missing_shard_of_a_committed_job_is_found(scene: SceneStore, name: str) -> None:
    shard(scene, name).unlink()
    assert_is_found(scene, name)


@pytest.mark.parametrize("name", ["modification", "view", "sample_modification", "sample_view", "sample_key"])
def test_a_flipped_bit_in_a_plans_inputs_is_found(scene: SceneStore, name: str) -> None:
    path = shard(scene, name)
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert_is_found(scene, "000000")


def test_a_flipped_bit_in_the_base_is_found(scene: SceneStore) -> None:
    path = next((scene.folder / "base/cloud/position").glob("c.*"))
    whole = path.read_bytes()
    path.write_bytes(whole[:20] + bytes([whole[20] ^ 1]) + whole[21:])
    assert_is_found(scene, "base")


def test_files_without_a_marker_are_not_samples_and_damaged_ones_are_replaced_by_the_next_commit(
    scene: SceneStore,
) -> None:
    marker = scene.folder / "committed/000000000000.json"
    marker.unlink()
    assert SceneReader(scene.folder.parent.parent, scene.scene_id).refresh().size == 0
    path = shard(scene, "depth")
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:5] + b"?" + whole[6:]):
        path.write_bytes(damaged)
        samples.commit(scene, 0, samples.outputs(scene, 0))
        assert path.read_bytes() == whole
        read_everything(scene)
        marker.unlink()
