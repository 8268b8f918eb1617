"""Servers that answer late, wrongly or not at all, and what a store in a bucket wants of one."""

import contextlib
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import bucket_samples
import numpy as np
import obstore
import pytest
import s3_server
import store_samples as samples
from obstore.exceptions import AlreadyExistsError, GenericError
from obstore.store import from_url

from photonfarm.core.errors import StoreError
from photonfarm.store import SceneReader, Store
from photonfarm.store.io import object_requests, objects
from photonfarm.store.io.objects import ObjectStorage

planned, put, at_once = bucket_samples.planned, bucket_samples.put, bucket_samples.at_once


@pytest.mark.parametrize("size", [10, 1_000_000])
def test_of_concurrent_conditional_puts_the_server_lets_exactly_one_win(url: str, size: int) -> None:
    """There are three puts, as the server lets each further loser wait a second longer."""
    bucket = from_url(url, client_options={"allow_http": True})

    def put(byte: int) -> bool:
        try:
            obstore.put(bucket, "contested", bytes([byte]) * size, mode="create", use_multipart=False)
        except AlreadyExistsError:
            return False
        return True

    for _ in range(4):
        won = at_once(*(lambda byte=byte: put(byte) for byte in range(3)))
        assert won.count(True) == 1
        assert bytes(obstore.get(bucket, "contested").bytes()) == bytes([won.index(True)]) * size
        obstore.delete(bucket, "contested")


def test_a_server_that_overwrites_against_its_orders_is_refused(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = obstore.put
    monkeypatch.setattr(obstore, "put", lambda *args, **how: plain(*args, **{**how, "mode": "overwrite"}))
    with pytest.raises(StoreError, match="If-None-Match"):
        Store(url, create=True)


def test_a_server_that_refuses_or_is_not_there_is_a_store_error(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    Store(url, create=True)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(StoreError):
        Store(url, create=True)
    (nobody,) = s3_server.free_ports(1)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{nobody}")
    monkeypatch.setattr(object_requests, "PATIENCE_S", 0.5)
    with pytest.raises(StoreError):
        Store(url)


@pytest.mark.slow
def test_a_server_that_is_away_for_a_while_is_waited_for(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed while a job is committed, and started again at the same port and folder, longer than 4 retries take."""
    monkeypatch.setattr(object_requests, "PAUSES_S", (0.1, 0.3))
    monkeypatch.setattr(object_requests, "LONGEST_PAUSE_S", 0.3)
    folder, ports = tmp_path_factory.mktemp("weed"), s3_server.free_ports(len(s3_server.PORTS))
    monkeypatch.setattr(s3_server, "free_ports", lambda _: ports)
    monkeypatch.setenv("PHOTONFARM_CACHE", str(tmp_path / "cache"))
    url, away = "s3://photonfarm/store", 1.5
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
        with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port)):
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
    monkeypatch.setattr(object_requests, "RETRIES", 0)
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
    monkeypatch.setattr(object_requests, "PATIENCE_S", 0.0)
    if size > objects.SMALL_BYTES:
        assert put(storage, bytes(size), "object")
    else:
        with pytest.raises(OSError, match="broke off"):
            put(storage, bytes(size), "object")


@pytest.mark.parametrize("size", [10, objects.SMALL_BYTES + 1])
def test_large_objects_are_put_one_at_a_time_and_small_ones_together(
    url: str, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    storage, plain, under_way = ObjectStorage(url), obstore.put, [0, 0]  # now, and at most
    storage.check()

    def counting(*args: Any, **how: Any) -> Any:
        under_way[0] += 1
        under_way[1] = max(under_way)
        time.sleep(0.2)
        made = plain(*args, **how)
        under_way[0] -= 1
        return made

    monkeypatch.setattr(obstore, "put", counting)
    assert all(at_once(*(lambda number=number: put(storage, bytes(size), f"object-{number}") for number in range(3))))
    assert (under_way[1] == 1) is (size > objects.SMALL_BYTES)


def test_a_refusal_is_told_at_once(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = ObjectStorage(url)
    put(storage, b"", "object")
    began = time.monotonic()
    with pytest.raises(FileNotFoundError):
        storage.read("nothing")
    assert ObjectStorage("s3://no-such-bucket/store").names("") == []
    with pytest.raises(StoreError):
        ObjectStorage("s3://no-such-bucket/store").names("scenes")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(PermissionError):
        ObjectStorage(url).read("object")
    assert time.monotonic() - began < 10


def test_the_servers_reason_is_told_without_its_xml_and_a_bucket_that_is_missing_by_that(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(StoreError, match="bucket"):
        Store("s3://no-such-bucket/store")
    with pytest.raises(StoreError):
        Store(url)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(StoreError, match="SignatureDoesNotMatch") as caught:
        Store(url)
    assert "<" not in str(caught.value)
    with pytest.raises(PermissionError):  # the answer to a HEAD has no more
        ObjectStorage(url).size("object")
