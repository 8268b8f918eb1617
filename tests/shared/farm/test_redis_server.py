"""The embedded Redis: ours alone, without a port, and with a memory."""

import os
import re
import signal
import socket
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from photonfarm.core.errors import QueueError
from photonfarm.farm.redis_server import EmbeddedRedis, server_binary
from photonfarm.queue.connection import connect


def alive(pid: int) -> bool:
    """Return whether a process runs; one that waits to be reaped does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except FileNotFoundError:
        return False


def test_it_answers_on_a_socket_of_this_user_and_on_no_port(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "redis") as server:
        connection = connect(server.url)
        assert connection.config_get("port")["port"] == "0"
        assert connection.config_get("appendonly")["appendonly"] == "yes"
        assert connection.config_get("appendfsync")["appendfsync"] == "everysec"
        assert connection.config_get("maxmemory-policy")["maxmemory-policy"] == "noeviction"
        assert stat.S_IMODE(server.socket.parent.stat().st_mode) == 0o700
        assert stat.S_IMODE((tmp_path / "redis").stat().st_mode) == 0o700


def test_it_survives_its_own_sudden_death(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path) as server:
        first, path = server.url, server.socket
        connect(server.url).set("key", "value")
        time.sleep(1.2)  # the append-only file is synced every second
        os.kill(server.pid, signal.SIGKILL)
    with EmbeddedRedis(tmp_path) as server:
        pid = server.pid
        assert server.url == first
        assert connect(server.url).get("key") == b"value"
    assert not alive(pid)
    assert not path.parent.exists()


def test_a_second_server_on_the_folder_is_refused_and_the_first_goes_on(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path) as server:
        with pytest.raises(QueueError), EmbeddedRedis(tmp_path):
            pass
        assert connect(server.url).ping()


def test_a_server_on_the_path_serves_where_the_package_has_none_for_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("platform.machine", lambda: "riscv64")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(QueueError, match="valkey-server or redis-server on PATH"):
        server_binary()
    (tmp_path / "redis-server").touch(mode=0o755)
    assert server_binary() == tmp_path / "redis-server"


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a child with its parent")
def test_it_does_not_outlive_a_killed_parent_and_its_folder_can_be_used_again(tmp_path: Path) -> None:
    code = """
import sys, time
from photonfarm.farm.redis_server import EmbeddedRedis, server_binary
with EmbeddedRedis(sys.argv[1]) as server:
    print(server.pid, flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE) as parent:
        pid = int(parent.stdout.readline())
        parent.kill()
    deadline = time.monotonic() + 10
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(pid)
    with EmbeddedRedis(tmp_path) as server:
        assert connect(server.url).ping()


@pytest.mark.parametrize("url", ["redis://127.0.0.1:1/0", "unix:///nowhere/redis.sock", "http://localhost", "nonsense"])
def test_no_redis_is_a_queue_error_that_names_the_url(url: str) -> None:
    with pytest.raises(QueueError, match=re.escape(url)):
        connect(url)


def test_a_password_is_not_repeated_in_an_error() -> None:
    with pytest.raises(QueueError) as caught:
        connect("redis://user:hunter2@127.0.0.1:1/0")
    assert "hunter2" not in str(caught.value)


def test_what_listens_but_is_no_redis_is_a_queue_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"redis://127.0.0.1:{server.getsockname()[1]}/0?socket_timeout=0.2"
        with pytest.raises(QueueError):
            connect(url)


def test_a_folder_may_have_blanks_quotes_and_umlauts_in_its_path(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path / "my 'own' Küche \"x\"" / "redis") as server:
        assert len(str(server.socket)) < 108
        connect(server.url).set("key", "value")
    assert list((tmp_path / "my 'own' Küche \"x\"" / "redis").rglob("*.aof"))


def test_a_redis_of_ones_own_is_one_process_and_ends_with_it(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "photonfarm.cli", "redis", "--port", str(port)]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL) as server:
        url, end = f"redis://127.0.0.1:{port}/0", time.monotonic() + 20
        while True:
            try:
                connection = connect(url)
                break
            except QueueError:
                assert time.monotonic() < end
                time.sleep(0.05)
        assert connection.info("server")["process_id"] == server.pid
        server.terminate()
        assert server.wait(10) == 0
    with pytest.raises(QueueError):
        connect(url)
    assert list(tmp_path.iterdir()) == []
