"""The copies of a bucket's objects that this machine keeps, and those of them that are damaged."""

import time
from collections.abc import Callable
from pathlib import Path

import bucket_samples
import numpy as np
import pytest
import store_samples as samples

from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.check.check import check_store
from photonfarm.store.io import object_cache
from photonfarm.store.io.objects import ObjectStorage

planned, put = bucket_samples.planned, bucket_samples.put


def test_an_object_is_copied_once_and_again_when_it_has_been_replaced(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = ObjectStorage(url)
    fetched: list[str] = []
    monkeypatch.setattr(storage, "_fetch", lambda name, *rest: (fetched.append(name), fetch(name, *rest)))
    fetch = ObjectStorage(url)._fetch
    assert not storage.local("object").exists()
    put(storage, b"first", "object")
    assert [storage.local("object").read_bytes() for _ in range(2)] == [b"first"] * 2
    assert fetched == ["object"]
    storage.local("object").write_bytes(b"firs")  # cut, as by a power failure
    assert storage.local("object").read_bytes() == b"first"
    put(storage, b"second", "object", replace=True)
    assert storage.local("object").read_bytes() == b"second"
    assert list((storage._cache._parts.root / "tmp").iterdir()) == []


def test_copies_used_longest_ago_make_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_cache, "KEPT_S", 0.0)
    cache = object_cache.ObjectCache(tmp_path, 1000)
    for i in range(20):
        with cache.filling(cache.path(f"folder/{i}", "v")) as file:
            file.write(bytes(100))
        assert cache.has(cache.path("folder/0", "v"), 100)
        time.sleep(0.01)
    left = {int(path.name.split("@")[0]) for path in (tmp_path / "files/folder").iterdir()}
    assert 0 in left
    assert {18, 19} <= left
    assert 8 <= len(left) <= 10


def a_row(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[10] ^= 1
    path.write_bytes(content)


def the_index(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-7] ^= 1
    path.write_bytes(content)


HARMS = (a_row, the_index)


@pytest.fixture
def harmed(url: str, tmp_path: Path) -> Callable[[Callable[[Path], None]], SceneStore]:
    """A whole scene in a bucket, and its copies on this machine, which are harmed."""

    def make(harm: Callable[[Path], None]) -> SceneStore:
        scene = planned(url, modifications=4)
        scene.write_base(*samples.base())
        samples.commit_all(scene)
        assert check_store(Store(url), when="now").exit_code == 0
        copies = [path for path in (tmp_path / "cache").rglob("c.*@*") if path.stat().st_size]
        assert len(copies) >= 8
        for copy in copies:
            harm(copy)
        return scene

    return make


@pytest.mark.parametrize("harm", HARMS)
@pytest.mark.parametrize("when", ["before it is opened", "while it is open"])
def test_a_reader_heals_from_a_copy_that_is_damaged_on_this_machine(
    url: str, harmed: Callable[..., SceneStore], harm: Callable[[Path], None], when: str
) -> None:
    is_open = when == "while it is open"
    scene = harmed((lambda _: None) if is_open else harm)
    reader = SceneReader(url, scene.scene_id)
    reader.refresh()
    truth = {row: given for job in (0, 1) for row, given in samples.outputs(scene, job).radiance.items()}
    if is_open:
        reader.read(0)
        harm(scene.storage.local(f"{scene.name}/plans/000000/radiance/c.0.0.0.0.0"))
    for row, radiance in truth.items():
        np.testing.assert_array_equal(reader.read(row).radiance, radiance)
        assert np.isfinite(reader.read_photons(row).power).all()
    again = SceneReader(url, scene.scene_id)
    again.refresh()
    np.testing.assert_array_equal(again.read(0).radiance, truth[0])


@pytest.mark.parametrize("harm", HARMS)
def test_a_copy_that_is_damaged_on_this_machine_is_no_damage_of_the_store(
    url: str, harmed: Callable[..., SceneStore], harm: Callable[[Path], None]
) -> None:
    scene = harmed(harm)
    report = check_store(Store(url), when="now", repair=True)
    assert (report.exit_code, [scene.groups for scene in report.scenes]) == (0, [()])
    assert (report.scenes[0].jobs, report.scenes[0].samples) == (2, 4), "none is counted twice"
    assert scene.missing_jobs() == []
    assert scene.storage.names("quarantine") == []


def test_a_copy_that_fails_half_way_is_not_there(tmp_path: Path) -> None:
    cache = object_cache.ObjectCache(tmp_path, 1000)
    with pytest.raises(ZeroDivisionError), cache.filling(cache.path("name", "v")) as file:
        file.write(bytes(1 // 0))
    assert not cache.has(cache.path("name", "v"), 1)
    assert list((tmp_path / "tmp").iterdir()) == []
