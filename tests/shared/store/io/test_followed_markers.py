"""Looks at a scene's markers: what they find, and what they cost in a bucket of a thousand names and more."""

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import obstore
import pytest
import s3_server
from obstore.store import from_url

from photonfarm.store.format import markers
from photonfarm.store.format.markers import WHOLE_S, FollowedMarkers
from photonfarm.store.io.local import LocalStorage
from photonfarm.store.io.objects import ObjectStorage

SCENE = "scenes/0123"


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def put(url: str, *jobs: int) -> None:
    bucket = from_url(url, client_options={"allow_http": True})
    with ThreadPoolExecutor(16) as pool:
        list(pool.map(lambda job: obstore.put(bucket, markers.marker_name(SCENE, job), b"{}"), jobs))


def remove(url: str, job: int, scene: str = SCENE) -> None:
    obstore.delete(from_url(url, client_options={"allow_http": True}), markers.marker_name(scene, job))


def test_a_look_costs_two_requests_however_many_markers_there_are(
    port: int, url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One job failed long ago, and is missing among the first; 2600 markers are three listings."""
    requests: Counter[str] = Counter()

    def count(method: str, path: str) -> None:
        requests["list" if "list-type" in path else method] += 1

    with s3_server.faulty_way(port, count) as way:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{way}")
        storage = ObjectStorage(url)
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        costs = []
        for first, last in ((0, 600), (600, 2600)):
            put(url, *(job for job in range(first, last) if job != 7))
            followed = FollowedMarkers(storage, SCENE)
            assert len(followed.look()) == last - 1
            put(url, last + 1)
            requests.clear()
            assert followed.look() == {*range(last), last + 1} - {7}
            costs.append(dict(requests))
    assert costs == [{"list": 1}, {"list": 1, "HEAD": 1}], "a single listing, and the one that is missing"


def test_what_is_committed_late_and_out_of_order_is_found(url: str) -> None:
    put(url, *range(100, 130))
    followed = FollowedMarkers(ObjectStorage(url), SCENE)
    assert followed.look() == {*range(100, 130)}
    put(url, 0, 99, 130, 5000)
    assert followed.look() == {0, *range(99, 131), 5000}
    put(url, 1, 4999, 5001)
    assert followed.look() == {0, 1, *range(99, 131), 4999, 5000, 5001}


def test_what_a_repair_removes_is_seen_after_a_doubt_or_a_while(url: str) -> None:
    clock = Clock()
    put(url, *range(5))
    followed = FollowedMarkers(ObjectStorage(url), SCENE, clock=clock)
    assert followed.look() == {*range(5)}
    remove(url, 2)
    assert followed.look() == {*range(5)}
    followed.doubt()
    assert followed.look() == {0, 1, 3, 4}
    remove(url, 1)
    clock.now += WHOLE_S
    assert followed.look() == {0, 3, 4}


def test_in_a_folder_every_look_sees_all(tmp_path: Path) -> None:
    followed = FollowedMarkers(LocalStorage(tmp_path), SCENE)
    assert followed.look() == set()
    folder = tmp_path / SCENE / markers.COMMITTED
    folder.mkdir(parents=True)
    for job in range(3):
        (tmp_path / markers.marker_name(SCENE, job)).touch()
    assert followed.look() == {0, 1, 2}
    (tmp_path / markers.marker_name(SCENE, 1)).unlink()
    assert followed.look() == {0, 2}
