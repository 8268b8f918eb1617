"""`photonfarm status` where Redis does not answer: the store's part comes at once, and why there is no other, soon."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from photonfarm.shared.farm.redis_server import EmbeddedRedis
from photonfarm.shared.farm.status import ANSWER_S
from photonfarm.shared.store import Store


def test_a_frozen_redis_does_not_hold_up_what_the_store_knows(tmp_path: Path) -> None:
    Store(tmp_path / "store", create=True)
    with EmbeddedRedis(tmp_path / "redis") as running:
        assert running.pid is not None
        os.kill(running.pid, signal.SIGSTOP)
        try:
            words = ["status", "--store", str(tmp_path / "store"), "--redis", running.url]
            command = [sys.executable, "-m", "photonfarm.shared.cli", *words]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as status:
                assert status.stdout is not None
                assert status.stdout.readline().startswith("scene")
                began = time.monotonic()
                assert status.poll() is None, "Redis is still waited for"
                rest = status.stdout.read()
                assert status.wait() == 0
            assert time.monotonic() - began < ANSWER_S + 3
            assert "queue: no Redis at" in rest
        finally:
            os.kill(running.pid, signal.SIGCONT)
