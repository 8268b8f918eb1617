"""`photonfarm status` where Redis does not answer: what the store knows comes all the same, and soon."""

import json
import os
import signal
import time
from pathlib import Path

import pytest
import redis
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import QueueError
from photonfarm.farm import watch
from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.renderer.tools import doctor
from photonfarm.store import Store


def test_json_has_the_reason_that_the_text_has_where_nothing_is_known_of_the_queue(tmp_path: Path) -> None:
    Store(tmp_path / "store", create=True)
    words = ["status", "--store", str(tmp_path / "store"), "--redis", f"unix://{tmp_path}/none"]
    text = CliRunner().invoke(umbrella, words)
    found = json.loads(CliRunner().invoke(umbrella, [*words, "--json"]).stdout)
    assert found["queue"] is None
    assert found["no_queue"].startswith("no Redis at")
    assert text.stdout.splitlines()[-1] == f"queue: {found['no_queue']}"


def test_the_doctor_tells_of_a_redis_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    class Failing:
        def info(self, _: str) -> None:
            raise redis.exceptions.NoPermissionError("no permissions to run the 'info' command")

    monkeypatch.setattr("photonfarm.queue.connection.connect", lambda _: Failing())
    found = doctor._try("Redis", lambda: doctor._reaches("redis://h:1/0"))
    assert (found.works, found.exit_code) == (False, QueueError.exit_code)
    assert "no permissions" in found.detail


def test_a_frozen_redis_does_not_hold_up_what_the_store_knows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "ANSWER_S", 0.5)
    Store(tmp_path / "store", create=True)
    with EmbeddedRedis(tmp_path / "redis") as running:
        assert running.pid is not None
        os.kill(running.pid, signal.SIGSTOP)
        try:
            began = time.monotonic()
            done = CliRunner().invoke(umbrella, ["status", "--store", str(tmp_path / "store"), "--redis", running.url])
        finally:
            os.kill(running.pid, signal.SIGCONT)
    assert done.exit_code == 0
    assert time.monotonic() - began < 10
    assert done.stdout.startswith("scene")
    assert "queue: no Redis at" in done.stdout
