"""The server of the compose file and its password, which no message shows."""

import json
import os
import shutil
import socket
import subprocess
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

import pytest
import queue_samples
import redis
from redis.backoff import NoBackoff
from redis.retry import Retry

from photonfarm.core.errors import QueueError
from photonfarm.farm import submission
from photonfarm.farm.redis_server import EmbeddedRedis, server_binary
from photonfarm.plan.request import Request
from photonfarm.queue import rq_adapter
from photonfarm.queue.connection import add_password, connect
from photonfarm.queue.reconciliation import fill_seldom, reconcile
from photonfarm.queue.rq_adapter import open_queue, queue_status
from photonfarm.queue.workers import bury, release, report_consumed, take_name
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.store import SceneStore, Store

scene = queue_samples.scene
SCENE_ID, NAME = queue_samples.SCENE_ID, queue_samples.NAME
START = Path(__file__).parents[3] / "docker/redis.sh"
COMPOSE = Path(__file__).parents[3] / "docker-compose.yml"


@pytest.fixture(autouse=True)
def at_the_first_try(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is refused, or not there, is told without the three tries more that take a second."""
    monkeypatch.setattr("photonfarm.queue.connection.RETRY", Retry(NoBackoff(), 0))


# ------------------------------------------------------------------------------------------------------- permissions


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, Path]]:
    """The server as the compose file starts it: a port of it, and the file with its password."""
    folder = tmp_path_factory.mktemp("guarded")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    environment = {
        **os.environ,
        "REDIS_SERVER": str(server_binary()),
        "REDIS_DATA": str(folder),
        "REDIS_PORT": str(port),
        "REDIS_BIND": "127.0.0.1",
        "PHOTONFARM_REDIS_PASSWORD_FILE": str(folder / "password"),
    }
    with (
        (folder / "log").open("wb") as log,
        subprocess.Popen(["sh", str(START)], env=environment, stdout=log) as process,
    ):
        deadline = time.monotonic() + 60
        while "eady to accept connections" not in (folder / "log").read_text():
            assert process.poll() is None, (folder / "log").read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        yield port, folder / "password"
        process.terminate()


def test_the_server_of_the_compose_file_lets_nobody_in_without_the_password(guarded: tuple[int, Path]) -> None:
    port, password = guarded
    for user in ("", "default:@", "default:wrong@", "photonfarm:wrong@", "photonfarm:@"):
        with pytest.raises(QueueError):
            connect(f"redis://{user}127.0.0.1:{port}/0")
    assert len(password.read_text().strip()) == 64


def test_who_lacks_a_name_or_a_password_is_told_which_and_nobody_to_start_a_server(
    guarded: tuple[int, Path], store: Store, tmp_path: Path
) -> None:
    port, _ = guarded
    url = f"redis://127.0.0.1:{port}/0"
    with pytest.raises(QueueError, match="PHOTONFARM_REDIS_PASSWORD_FILE"):
        connect(url)
    (tmp_path / "password").write_text("wrong")
    with pytest.raises(QueueError, match="redis://default@host"):
        connect(add_password(tmp_path / "password", url))
    request = Request(modifications=1)
    with pytest.raises(QueueError) as refused:
        submission.submit(NamedSpec.load("cornell"), store.root, url, request)
    assert "photonfarm redis" not in str(refused.value)
    with pytest.raises(QueueError, match="photonfarm redis"):
        submission.submit(NamedSpec.load("cornell"), store.root, "redis://127.0.0.1:1/0", request)


def test_the_password_of_a_plain_redis_goes_with_the_user_that_it_has(tmp_path: Path) -> None:
    (tmp_path / "password").write_text("secret")
    with EmbeddedRedis(tmp_path / "redis") as running, connect(running.url) as plain:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        plain.config_set("port", port)
        plain.config_set("requirepass", "secret")
        with pytest.raises(QueueError):
            connect(add_password(tmp_path / "password", f"redis://127.0.0.1:{port}/0"))
        with pytest.raises(QueueError, match=r"does not let in the user default .*; check the password"):
            connect(f"redis://default:wrong@127.0.0.1:{port}/0")
        with connect(add_password(tmp_path / "password", f"redis://default@127.0.0.1:{port}/0")) as let_in:
            assert let_in.ping()


def test_rq_and_all_of_ours_work_with_the_permissions_of_the_compose_file(
    guarded: tuple[int, Path], store: Store, scene: SceneStore
) -> None:
    port, password = guarded
    with connect(add_password(password, f"redis://127.0.0.1:{port}/0")) as limited:
        assert reconcile(store, limited) == 10
        assert take_name(limited, "worker", ttl_s=60) == "worker"
        assert take_name(limited, "worker", ttl_s=60) == "worker-2"
        report_consumed(limited, SCENE_ID, 1)
        assert fill_seldom(store, limited, every_s=60) == "waits"
        rq_adapter.finish(rq_adapter.open_queue(limited), queue_samples.taken(limited))
        queue_samples.failed(limited, "broken")
        rq_adapter.fail_of_worker(limited, queue_samples.taken(limited, "worker").worker_name, "killed", counts=False)
        status = queue_status(limited)
        assert (status.queued, status.running, status.workers, len(status.failed)) == (8, 0, 2, 1)
        assert reconcile(store, limited, retry=True) == 2
        for name in ("worker", "worker-2"):
            bury(limited, name)
        release(limited, store)
        forbidden = (
            ("FLUSHALL",),
            ("CONFIG", "GET", "dir"),
            ("KEYS", "*"),
            ("SHUTDOWN",),
            ("ACL", "LIST"),
            ("SET", "other", "1"),
            ("PUBLISH", "rq:pubsub:x", "{}"),
            ("MODULE", "LIST"),
            ("REPLICAOF", "h", "1"),
        )
        for command in forbidden:
            with pytest.raises(redis.exceptions.NoPermissionError):
                limited.execute_command(*command)


LENGTH = """
local kind = redis.call('TYPE', KEYS[1]).ok
return redis.call(kind == 'zset' and 'ZCARD' or 'LLEN', KEYS[1])
"""
"""The length of a list or a sorted set, by a script of the commands that KEDA's own uses."""


def test_an_autoscaler_may_count_what_waits_and_what_was_started(
    guarded: tuple[int, Path], store: Store, scene: SceneStore
) -> None:
    port, password = guarded
    with connect(add_password(password, f"redis://127.0.0.1:{port}/0")) as limited:
        jobs = open_queue(limited)
        lengths = limited.register_script(LENGTH)
        waiting, started = jobs.key, jobs.started_job_registry.key
        limited.delete(waiting, started, jobs.intermediate_queue_key)
        assert [lengths(keys=[key]) for key in (waiting, started)] == [0, 0]
        reconcile(store, limited)
        limited.zadd(started, {f"{NAME}:execution": time.time() + 60})
        assert [lengths(keys=[key]) for key in (waiting, started)] == [len(jobs), 1]
        assert len(jobs) > 0
        limited.delete(waiting, started)
        release(limited, store)


def test_the_health_check_of_the_compose_file_shows_the_password_to_nobody(
    guarded: tuple[int, Path], tmp_path: Path
) -> None:
    """It is run with a `redis-cli` that tells what it was given, and then does its work if it is there."""
    port, password = guarded
    (line,) = [line for line in COMPOSE.read_text().splitlines() if "redis-cli" in line]
    _, check = json.loads(line.partition(": ")[2])
    real = shutil.which("redis-cli")
    told, fake = tmp_path / "told", tmp_path / "redis-cli"
    ping = f'exec "{real}" -p {port} "$@"' if real else "read -r word; [ ${#word} = 64 ] && echo PONG"
    fake.write_text(f'#!/bin/sh\nenv > "{told}"\necho "$@" >> "{told}"\n{ping}\n')
    fake.chmod(0o755)

    def rc(file: Path) -> int:
        command = check.replace("$$", "$").replace("/run/photonfarm/redis_password", str(file))
        environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
        return subprocess.run(["sh", "-c", command], env=environment, check=False, stderr=subprocess.DEVNULL).returncode

    assert rc(password) == 0
    assert "ping" in told.read_text()
    assert password.read_text().strip() not in told.read_text()
    (tmp_path / "wrong").write_text("wrong\n")
    assert rc(tmp_path / "wrong") != 0


# ---------------------------------------------------------------------------------------------------------- passwords

SECRET = "hunter2"


@pytest.mark.parametrize(
    "url",
    [
        f"redis://user:{SECRET}@127.0.0.1:1/0",
        f"redis://:{SECRET}@127.0.0.1:1/0",
        f"redis://:{SECRET}/x@127.0.0.1:1/0",
        f"redis://:12/{SECRET}@127.0.0.1:1/0",
        f"redis://:{SECRET}?x@127.0.0.1:1/0",
        f"redis://:{SECRET}#x@127.0.0.1:1/0",
        f"redis://:a@{SECRET}@127.0.0.1:1/0",
        f"redis://user:{SECRET}@127.0.0.1:port/0",
        f"redis://127.0.0.1:1/0?password={SECRET}",
        f"redis://127.0.0.1:1/0?password=x@{SECRET}",
        f"unix://user:{SECRET}@/nowhere/redis.sock",
        f"user:{SECRET}@127.0.0.1",
        f"http://user:{SECRET}@127.0.0.1:1",
        f"redis://user:{SECRET}@[127.0.0.1:1/0",
    ],
)
def test_a_password_is_in_no_message_and_in_no_traceback(url: str) -> None:
    with pytest.raises(QueueError) as caught:
        connect(url)
    assert SECRET not in "".join(traceback.format_exception(caught.value))


def test_a_password_that_is_wrong_is_in_no_message(guarded: tuple[int, Path]) -> None:
    with pytest.raises(QueueError) as caught:
        connect(f"redis://photonfarm:{SECRET}@127.0.0.1:{guarded[0]}/0")
    assert SECRET not in "".join(traceback.format_exception(caught.value))


def test_a_password_comes_from_a_file_where_the_url_has_none(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("a/b@c:d\n")
    quoted = "a%2Fb%40c%3Ad"
    assert add_password(file, "redis://h:1/0") == f"redis://photonfarm:{quoted}@h:1/0"
    assert add_password(file, "rediss://ada@h:1/0?x=1") == f"rediss://ada:{quoted}@h:1/0?x=1"
    for url in ("redis://ada:own@h:1/0", "unix:///run/redis.sock"):
        assert add_password(file, url) == url
    assert add_password(None, "redis://h:1/0") == "redis://h:1/0"
    with pytest.raises(QueueError):
        add_password(tmp_path / "none", "redis://h:1/0")
