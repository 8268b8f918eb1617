"""A store in a bucket behaves like one in a folder."""

import contextlib
import importlib.util
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import obstore
import pytest
import zarr
from click.testing import CliRunner
from obstore.exceptions import AlreadyExistsError, GenericError
from obstore.store import from_url
from zarr.storage import ObjectStore

from photonfarm.shared.cli import umbrella
from photonfarm.shared.errors import CorruptError, StoreError
from photonfarm.shared.plan import Request
from photonfarm.shared.store import SceneReader, SceneStore, Store, object_cache, objects, store_status
from photonfarm.shared.store.check import check_store
from photonfarm.shared.store.find import Query, find_samples
from photonfarm.shared.store.findings import Cause
from photonfarm.shared.store.objects import ObjectStorage
from photonfarm.shared.store.storage import open_storage


def beside(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


samples, s3_server = beside("store_samples"), beside("s3_server")


@pytest.fixture(scope="session")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    with s3_server.running(tmp_path_factory.mktemp("s3")) as found:
        yield found


@pytest.fixture
def url(port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A place of its own for each test, in a bucket."""
    for name, value in s3_server.environment(port).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("PHOTONFARM_CACHE", str(tmp_path / "cache"))
    return f"s3://photonfarm/{tmp_path.name}"


@pytest.fixture(params=["folder", "bucket"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str | Path:
    """Where a store may be made."""
    return request.getfixturevalue("url") if request.param == "bucket" else tmp_path / "store"


def planned(place: str | Path, **request: int) -> SceneStore:
    """A scene with jobs of 2 samples."""
    store = Store(place, create=True)
    return store.scene(store.plan(samples.small_spec(), Request(**request), shard_rows=2).scene_id)


def at_once(*actions: Callable[[], Any]) -> list[Any]:
    """What the actions return, begun together, each in a thread of its own."""
    barrier, results = threading.Barrier(len(actions)), [None] * len(actions)

    def act(i: int) -> None:
        barrier.wait()
        results[i] = actions[i]()

    threads = [threading.Thread(target=act, args=(i,)) for i in range(len(actions))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results


# --------------------------------------------------------------------------------------------------------- the server


@pytest.mark.parametrize("size", [10, 1_000_000])
def test_of_concurrent_conditional_puts_the_server_lets_exactly_one_win(url: str, size: int) -> None:
    bucket = from_url(url, client_options={"allow_http": True})

    def put(byte: int) -> bool:
        try:
            obstore.put(bucket, "contested", bytes([byte]) * size, mode="create", use_multipart=False)
        except AlreadyExistsError:
            return False
        return True

    for _ in range(4):
        won = at_once(*(lambda byte=byte: put(byte) for byte in range(6)))
        assert won.count(True) == 1
        assert bytes(obstore.get(bucket, "contested").bytes()) == bytes([won.index(True)]) * size
        obstore.delete(bucket, "contested")


# ------------------------------------------------------------------------------------------- the same in both storages


def test_what_is_committed_reads_back_and_is_counted(place: str | Path) -> None:
    scene = planned(place, modifications=2)
    scene.write_base(*samples.base())
    geometry, cloud = samples.base()
    scene.write_base(replace(geometry, vertices=geometry.vertices + 1), cloud)
    given = samples.outputs(scene, 0)
    given.radiance[1][0, 0, 0, 0] = 1e9
    assert samples.commit(scene, 0, given)
    assert not samples.commit(scene, 0, samples.outputs(scene, 0))

    reader = SceneReader(place, scene.scene_id)
    assert reader.refresh().tolist() == [0, 1]
    for row in (0, 1):
        np.testing.assert_array_equal(reader.read(row).radiance, given.radiance[row])
        np.testing.assert_array_equal(reader.read(row).buffers.normal, given.buffers[row].normal)
        np.testing.assert_array_equal(reader.read_photons(row).power, given.photons[row].power)
    np.testing.assert_array_equal(reader.base()[0].vertices, geometry.vertices)
    (status,) = store_status(Store(place))
    assert (status.samples_planned, status.samples_complete, status.jobs_committed) == (2, 2, 1)
    assert status.size_bytes == sum(scene.storage.size(f"{scene.name}/{name}") for name in scene.marker(0)["files"])


def test_a_reader_waits_for_store_scene_plan_and_samples(place: str | Path) -> None:
    spec = samples.small_spec()
    reader = SceneReader(place, spec.scene_id)
    assert reader.refresh().size == 0
    store = Store(place, create=True)
    assert (store.scenes(), reader.refresh().size) == ([], 0)
    store.add(spec)
    assert reader.refresh().size == 0
    with pytest.raises(StoreError, match="base is not there yet"):
        reader.base()
    scene = planned(place)
    assert reader.refresh().size == 0
    samples.commit_all(scene)
    assert reader.refresh().tolist() == [0]


def test_racing_submitters_plan_every_sample_once(place: str | Path) -> None:
    """Three requests overlap; whoever comes late plans what is left."""
    scene = planned(place)
    requests = [Request(modifications=count, views_per_modification=views) for count, views in ((2, 2), (3, 1), (2, 3))]
    results = at_once(*(lambda wanted=wanted: Store(place).plan(samples.small_spec(), wanted) for wanted in requests))
    plans = scene.plans()
    assert [result.plan for result in results if result.plan is not None] == [
        result.plan for result in results if result.new
    ]
    keys = [key.tobytes() for plan in plans for key in plan.rows.sample_key[plan.rows.sample_modification >= 0]]
    assert len(keys) == len(set(keys)) == 2 * 3 + 1
    assert [plan.number for plan in plans] == list(range(len(plans)))
    assert [plan.first_job for plan in plans] == [0, *(plan.end_job for plan in plans[:-1])]
    for wanted in requests:
        assert Store(place).plan(samples.small_spec(), wanted).new == 0


def test_racing_writers_leave_one_commit_that_its_marker_describes(place: str | Path) -> None:
    scene = planned(place, modifications=2)
    first = samples.outputs(scene, 0)
    second = replace(first, radiance={row: values + 1 for row, values in first.radiance.items()})
    won = at_once(
        *(lambda given=given: samples.commit(Store(place).scene(scene.scene_id), 0, given) for given in (first, second))
    )
    assert won.count(True) == 1
    reader = SceneReader(place, scene.scene_id)
    assert reader.refresh().tolist() == [0, 1]
    stored = {row: reader.read(row).radiance for row in (0, 1)}
    assert any(all(np.array_equal(stored[row], given.radiance[row]) for row in stored) for given in (first, second))
    for name, about in scene.marker(0)["files"].items():
        assert scene.storage.size(f"{scene.name}/{name}") == about["size"]


def test_a_damaged_file_that_a_dead_writer_left_is_replaced(place: str | Path) -> None:
    scene = planned(place, modifications=2)
    part = scene.storage.part()
    part.write_bytes(b"half a shard")
    assert scene.storage.adopt(part, f"{scene.name}/plans/000000/radiance/c.0.0.0.0.0")
    given = samples.outputs(scene, 0)
    assert samples.commit(scene, 0, given)
    reader = SceneReader(place, scene.scene_id)
    reader.refresh()
    np.testing.assert_array_equal(reader.read(1).radiance, given.radiance[1])


def test_files_and_folders_can_be_set_aside_and_written_anew(place: str | Path) -> None:
    scene = planned(place)
    scene.write_base(*samples.base())
    samples.commit(scene, 0, samples.outputs(scene, 0))
    storage, marker = scene.storage, f"{scene.name}/committed/000000000000.json"
    was = storage.read(marker)
    storage.move(marker, "quarantine/marker.json")
    assert (storage.exists(marker), storage.read("quarantine/marker.json")) == (False, was)
    with pytest.raises(FileNotFoundError):
        storage.move(marker, "quarantine/again.json")
    with pytest.raises(FileExistsError):
        storage.move("photonfarm.json", "quarantine/marker.json")
    storage.move_folder(f"{scene.name}/base", "quarantine/base")
    assert not scene.has_base()
    assert "geometry" in storage.names("quarantine/base")
    geometry, cloud = samples.base()
    scene.write_base(replace(geometry, vertices=geometry.vertices + 1), cloud)
    np.testing.assert_array_equal(SceneReader(place, scene.scene_id).base()[0].vertices, geometry.vertices + 1)
    assert samples.commit(scene, 0, samples.outputs(scene, 0))


# ---------------------------------------------------------------------------------------------------------- the bucket


def test_zarr_python_reads_a_plan_out_of_the_bucket(url: str) -> None:
    scene = planned(url, modifications=2)
    given = samples.outputs(scene, 0)
    samples.commit(scene, 0, given)
    bucket = from_url(f"{url}/{scene.name}/plans/000000", client_options={"allow_http": True})
    plan = zarr.open_group(ObjectStore(bucket, read_only=True), mode="r")
    assert {"radiance", "depth", "photon_power", "sample_key"} <= set(plan.array_keys())
    np.testing.assert_array_equal(plan["radiance"][1].astype(np.float32), given.radiance[1])
    np.testing.assert_array_equal(plan["depth"][:], np.stack([given.buffers[row].depth for row in (0, 1)]))


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


def put(storage: ObjectStorage, content: bytes, name: str, **how: Any) -> bool:
    part = storage.part()
    part.write_bytes(content)
    return storage.adopt(part, name, **how)


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


def the_end(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def all_of_it(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


HARMS = (a_row, the_index, the_end, all_of_it)


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


@pytest.mark.parametrize("harm", HARMS[1:])
def test_what_is_looked_up_is_there_though_its_copy_on_this_machine_is_damaged(
    url: str, harmed: Callable[..., SceneStore], harm: Callable[[Path], None]
) -> None:
    scene = harmed(harm)
    (sample,) = find_samples(Store(url), [scene.scene_id], Query.of(row=0)).samples
    assert all(place.there for place in sample.places)


def test_an_object_that_is_damaged_in_the_bucket_is_fetched_once_more_and_found(url: str) -> None:
    scene = planned(url, modifications=4)
    scene.write_base(*samples.base())
    samples.commit_all(scene)
    name = f"{scene.name}/plans/000000/radiance/c.0.0.0.0.0"
    content = bytearray(scene.storage.read(name))
    content[10] ^= 1
    put(scene.storage, bytes(content), name, replace=True)
    reader = SceneReader(url, scene.scene_id)
    reader.refresh()
    with pytest.raises(CorruptError, match="fails its CRC-32C"):
        reader.read(0)
    report = check_store(Store(url), when="now", repair=True)
    assert [group.cause for group in report.scenes[0].groups] == [Cause.CHECKSUM]
    assert report.scenes[0].set_aside == ("job 0",)
    assert scene.missing_jobs() == [0]


def test_a_damaged_plan_in_the_bucket_is_written_again_from_its_request(url: str) -> None:
    scene = planned(url, modifications=4)
    scene.write_base(*samples.base())
    samples.commit_all(scene)
    name = f"{scene.name}/plans/000000/view/c.0.0"
    whole = scene.storage.read(name)
    put(scene.storage, whole[:-1] + bytes([whole[-1] ^ 1]), name, replace=True)
    report = check_store(Store(url), when="now", repair=True)
    assert (report.exit_code, [group.cause for group in report.scenes[0].groups]) == (7, [Cause.PLAN_INPUTS])
    assert scene.storage.read(name) == whole
    assert scene.storage.exists(f"{report.quarantine}/{name}")
    assert check_store(Store(url), when="now").exit_code == 0


def test_a_claim_is_completed_from_the_bucket_and_not_from_a_damaged_copy(url: str) -> None:
    scene = planned(url, modifications=2)
    claim, folder = f"{scene.name}/plans/000001.claim", f"{scene.name}/plans/000001"
    scene.plan(Request(modifications=4))
    all_of_it(scene.storage.local(claim))
    scene.storage.move(f"{folder}/zarr.json", "aside")
    part = scene.storage.part()
    part.mkdir()
    assert not scene.storage.adopt_folder(part, folder)
    assert scene.storage.read(f"{folder}/zarr.json") == scene.storage.read("aside")


def test_a_copy_that_fails_half_way_is_not_there(tmp_path: Path) -> None:
    cache = object_cache.ObjectCache(tmp_path, 1000)
    with pytest.raises(ZeroDivisionError), cache.filling(cache.path("name", "v")) as file:
        file.write(bytes(1 // 0))
    assert not cache.has(cache.path("name", "v"), 1)
    assert list((tmp_path / "tmp").iterdir()) == []


def test_a_server_that_overwrites_against_its_orders_is_refused(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = obstore.put
    monkeypatch.setattr(obstore, "put", lambda *args, **how: plain(*args, **{**how, "mode": "overwrite"}))
    with pytest.raises(StoreError, match="ignores `If-None-Match"):
        Store(url, create=True)


def test_a_server_that_refuses_or_is_not_there_is_a_store_error_that_says_so(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    Store(url, create=True)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(StoreError, match=f"{url}: cannot .*403 Forbidden"):
        Store(url, create=True)
    (nobody,) = s3_server.free_ports(1)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{nobody}")
    monkeypatch.setattr(objects, "PATIENCE_S", 0.5)
    with pytest.raises(StoreError, match=f"{url}: cannot"):
        Store(url)


# -------------------------------------------------------------------------------------------------------------- outages


def test_a_server_that_is_away_for_a_while_is_waited_for(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed while a job is committed, and started again at the same port and folder, longer than 4 retries take."""
    folder, ports = tmp_path_factory.mktemp("weed"), s3_server.free_ports(len(s3_server.PORTS))
    monkeypatch.setattr(s3_server, "free_ports", lambda _: ports)
    monkeypatch.setenv("PHOTONFARM_CACHE", str(tmp_path / "cache"))
    url, away = "s3://photonfarm/store", 3.0
    with contextlib.ExitStack() as server:
        port = server.enter_context(s3_server.running(folder))
        for name, value in s3_server.environment(port).items():
            monkeypatch.setenv(name, value)
        scene = planned(url, modifications=4)
        given = samples.outputs(scene, 0)
        assert samples.commit(scene, 1, samples.outputs(scene, 1))
        reader = SceneReader(url, scene.scene_id)
        assert reader.refresh().tolist() == [2, 3]
        server.close()
        with pytest.raises(OSError, match="refused"), socket.create_connection(("127.0.0.1", port)):
            pass

        began = time.monotonic()
        with ThreadPoolExecutor(1) as worker:
            committed = worker.submit(samples.commit, scene, 0, given)
            time.sleep(away)
            assert not committed.done()
            server.enter_context(s3_server.running(folder))  # by this thread: it ends with the one that starts it
            assert committed.result()
        assert time.monotonic() - began > away
        assert reader.refresh().tolist() == [0, 1]
        np.testing.assert_array_equal(reader.read(0).radiance, given.radiance[0])


def test_an_answer_that_breaks_off_is_asked_for_again(url: str, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    put(ObjectStorage(url), bytes(100), "object")
    monkeypatch.setattr(objects, "RETRIES", 0)
    faults = iter(["answer", "request"])
    with s3_server.faulty_way(port, lambda method, _: next(faults, None) if method == "GET" else None) as way:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{way}")
        assert ObjectStorage(url).read("object") == bytes(100)
    assert next(faults, None) is None


@pytest.mark.parametrize("size", [10, objects.SMALL_BYTES + 1])
def test_a_long_transfer_that_breaks_off_is_begun_again_though_its_time_is_over(
    url: str, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    storage = ObjectStorage(url)
    storage.check()
    failures, plain = iter([GenericError("the connection broke off")]), obstore.put

    def breaking(*args: Any, **how: Any) -> Any:
        if (failure := next(failures, None)) is not None:
            raise failure
        return plain(*args, **how)

    monkeypatch.setattr(obstore, "put", breaking)
    monkeypatch.setattr(objects, "PATIENCE_S", 0.0)
    if size > objects.SMALL_BYTES:
        assert put(storage, bytes(size), "object")
    else:
        with pytest.raises(OSError, match="broke off"):
            put(storage, bytes(size), "object")


def test_a_refusal_is_told_at_once(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = ObjectStorage(url)
    put(storage, b"", "object")
    began = time.monotonic()
    with pytest.raises(FileNotFoundError):
        storage.read("nothing")
    assert ObjectStorage("s3://no-such-bucket/store").names("") == []
    with pytest.raises(StoreError, match="the store is gone"):
        ObjectStorage("s3://no-such-bucket/store").names("scenes")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(PermissionError):
        ObjectStorage(url).read("object")
    assert time.monotonic() - began < 10


def test_the_servers_reason_is_told_without_its_xml_and_a_bucket_that_is_missing_by_that(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(StoreError, match=r"^s3://no-such-bucket/store: cannot be read: the bucket does not exist$"):
        Store("s3://no-such-bucket/store")
    with pytest.raises(StoreError, match=r"is not a store: photonfarm\.json is missing"):
        Store(url)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(
        StoreError, match=r"403 Forbidden: SignatureDoesNotMatch: The request signature .*\.$"
    ) as caught:
        Store(url)
    assert "<" not in str(caught.value)
    with pytest.raises(PermissionError, match="403 Forbidden"):  # the answer to a HEAD has no more
        ObjectStorage(url).size("object")


# ----------------------------------------------------------------------------------------------------- the command line


def test_verbs_take_a_url_and_the_plan_they_write_is_found_again(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(*arguments: str) -> Any:
        result = CliRunner().invoke(umbrella, [*arguments, "--json"], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    request = ["submit", "cornell", "--modifications", "2", "--views", "2", "--store", url]
    assert run(*request, "--dry-run")["planned"] == 4
    assert run(*request, "--no-queue")["planned"] == 4
    assert run(*request, "--dry-run")["planned"] == 0
    monkeypatch.setenv("PHOTONFARM_STORE", url)
    assert run("status", "--redis", "redis://127.0.0.1:1/0")["scenes"][0]["samples_planned"] == 4


@pytest.mark.parametrize("wrong", ["ftp://bucket/store", "s3://"])
def test_a_url_that_is_not_a_buckets_is_wrong_usage(wrong: str) -> None:
    result = CliRunner().invoke(umbrella, ["status", "--store", wrong])
    assert result.exit_code == 2
    assert "neither a folder nor s3://" in result.stderr


def test_without_the_library_a_url_is_refused_with_what_to_install() -> None:
    code = """
import sys
sys.modules["obstore"] = None
from photonfarm.shared.cli import main
main(["status", "--store", "s3://bucket/store"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == StoreError.exit_code
    assert "needs the package obstore" in done.stderr
    assert "photonfarm-shared[objects]" in done.stderr


def test_a_folders_store_does_not_load_the_library(tmp_path: Path) -> None:
    code = "import sys; from photonfarm.shared.store import Store; Store(sys.argv[1], create=True); " \
        "assert 'obstore' not in sys.modules"  # fmt: skip
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "store")], check=True)
    assert open_storage(tmp_path / "store").exists("photonfarm.json")


def test_a_bucket_that_has_lost_the_store_s_document_or_a_spec_is_refused_and_told(url: str) -> None:
    store = Store(url, create=True)
    scene = store.scene(store.plan(samples.small_spec(), Request()).scene_id)
    objects_ = store.storage._objects
    obstore.put(objects_, "scenes/nothex/plans/000000/zarr.json", b"{}")
    obstore.delete(objects_, f"{scene.name}/spec.json")
    assert store.scene_ids() == [scene.scene_id]
    (about,) = store_status(Store(url))
    assert "spec.json: is missing, and plans or markers of the scene are there" in str(about.error)
    obstore.delete(objects_, "photonfarm.json")
    with pytest.raises(CorruptError, match=r"photonfarm\.json: is missing, and scenes are there"):
        Store(url, create=True)
