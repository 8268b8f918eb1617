"""What tests of several packages start or render."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import analytic_scene
import pytest
import redis
import s3_server

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.queue.connection import connect
from photonfarm.store import Store

# Read where torch is loaded, also by processes that tests start: threads that turn while they wait would take from
# other tests the cores that these share, and images then take four times as long.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# Tests of equal bytes are of processors, also on a machine with a card; tests of cards ask for one.
os.environ.setdefault("PHOTONFARM_DEVICE", "cpu")


@pytest.fixture(scope="session")
def analytic() -> ModuleType:
    """The module `analytic_scene`."""
    return analytic_scene


@pytest.fixture
def hears_ctrl_c() -> Iterator[None]:
    """Let processes that the test starts hear SIGINT, which shells make background jobs ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def redis_server(tmp_path: Path) -> Iterator[EmbeddedRedis]:
    """A server of its own for each test, which may do with it what it likes."""
    with EmbeddedRedis(tmp_path / "redis") as server:
        yield server


@pytest.fixture(scope="session")
def common_redis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedRedis]:
    """A server for tests that change nothing but its keys."""
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as server:
        yield server


@pytest.fixture
def connection(common_redis: EmbeddedRedis) -> Iterator[redis.Redis]:
    """A connection to an empty Redis."""
    with connect(common_redis.url) as connected:
        connected.flushall()
        yield connected


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """An empty one."""
    return Store(tmp_path / "store", create=True)


@pytest.fixture(scope="session")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of an S3 server."""
    with s3_server.running(tmp_path_factory.mktemp("s3")) as found:
        yield found


@pytest.fixture
def url(port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A place of its own for each test, in a bucket."""
    for name, value in s3_server.environment(port).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("PHOTONFARM_CACHE", str(tmp_path / "cache"))
    return f"s3://photonfarm/{tmp_path.name}"
