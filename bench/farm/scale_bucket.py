"""Requests to a bucket by those who open a store of so many samples there: counted on their way to a real S3 server.

The server is that of the tests, of this machine. Markers are put beside it, so that only what is measured passes the
counting way.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from bench.farm.scale_store import SHARD_ROWS, SPEC, missing_of
from bench.harness import results

PUTS_AT_ONCE = 32

Costs = dict[str, float]


class Requests:
    """Requests by kind (list, get, head, put), and all of them (requests)."""

    def __init__(self) -> None:
        """Begin with none."""
        self.counts: Counter[str] = Counter()

    def seen(self, method: str, path: str) -> None:
        """Count a request, and let it pass."""
        is_list = method == "GET" and "list-type" in parse_qs(urlsplit(path).query)
        self.counts["list" if is_list else method.lower()] += 1

    def of(self, action: Callable[[], Any]) -> Costs:
        """The requests that an action makes."""
        self.counts.clear()
        action()
        found = {kind: float(count) for kind, count in self.counts.items()}
        return {**found, "requests": sum(found.values())}


def measured(folder: Path, samples: int) -> dict[str, Costs]:
    """The requests of each step, by its name, at so many samples."""
    sys.path.insert(0, str(results.ROOT / "tests/shared"))
    s3_server = importlib.import_module("s3_server")
    requests = Requests()
    (folder / "s3").mkdir()
    with (
        s3_server.running(folder / "s3") as port,
        s3_server.faulty_way(port, requests.seen) as way,
        _variables({**s3_server.environment(way), "PHOTONFARM_CACHE": str(folder / "cache")}),
    ):
        return _steps(f"s3://photonfarm/scale-{samples}", samples, requests, s3_server.environment(port))


@contextlib.contextmanager
def _variables(values: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _steps(url: str, samples: int, requests: Requests, direct: dict[str, str]) -> dict[str, Costs]:
    from photonfarm.plan.request import Request
    from photonfarm.scene.spec_loading import NamedSpec
    from photonfarm.store import SceneReader, Store
    from photonfarm.store.format import markers

    spec = NamedSpec.load(SPEC).spec
    found: dict[str, Costs] = {}
    store = Store(url, create=True)
    request = Request(modifications=samples)
    found["plan"] = requests.of(lambda: store.plan(spec, request, shard_rows=SHARD_ROWS))
    scene = store.scene(spec.scene_id)
    jobs = scene.jobs()
    missing = missing_of(jobs)
    done = sorted({*range(jobs)} - {*missing})
    _put_markers([markers.name_of(scene.name, job) for job in done], url, direct)

    def first_job() -> None:
        fresh = Store(url).scene(spec.scene_id)
        fresh.jobs()
        fresh.is_committed(jobs - 1)
        fresh.job_rows(jobs - 1)

    found["worker"] = requests.of(first_job)
    fresh = Store(url).scene(spec.scene_id)
    found["missing"] = requests.of(fresh.missing_jobs)
    reader = SceneReader(url, spec.scene_id)
    found["start"] = requests.of(reader.refresh)
    found["refresh"] = requests.of(reader.refresh)
    pace = _pace(url)
    pace()
    found["pace"] = requests.of(pace)
    _put_markers([markers.name_of(scene.name, missing[-1])], url, direct)
    found["news"] = requests.of(reader.refresh)
    return found


def _pace(url: str) -> Callable[[], object]:
    """The looks of a worker with --ahead at what is committed."""
    from photonfarm.renderer.worker.backpressure import TrainerPace
    from photonfarm.store import Store

    return TrainerPace(Store(url), None, 1.5)._progress  # type: ignore[arg-type]  # it asks Redis elsewhere


def _put_markers(names: list[str], url: str, direct: dict[str, str]) -> None:
    """Put objects under names of markers, past the counting way: listings ask for names alone."""
    from concurrent.futures import ThreadPoolExecutor

    import obstore
    from obstore.store import S3Store

    bucket, _, prefix = url.removeprefix("s3://").partition("/")
    store = S3Store(
        bucket, prefix=prefix, client_options={"allow_http": True},
        config={
            "endpoint": direct["AWS_ENDPOINT_URL"], "region": direct["AWS_REGION"],
            "access_key_id": direct["AWS_ACCESS_KEY_ID"], "secret_access_key": direct["AWS_SECRET_ACCESS_KEY"],
        },
    )  # fmt: skip
    with ThreadPoolExecutor(PUTS_AT_ONCE) as pool:
        list(pool.map(lambda name: obstore.put(store, name, b"{}"), names))
