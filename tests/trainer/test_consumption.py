"""The trainer tells Redis how many samples it has used; whether there is one is none of its trouble."""

import time
from pathlib import Path

import pytest

from photonfarm.shared.queue import connect, consumed_samples
from photonfarm.shared.redis_server import EmbeddedRedis
from photonfarm.trainer import service

SCENE_ID = "0123456789abcdef" * 2


def test_what_is_used_is_told_again_and_again_each_sample_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "TELL_S", 0.01)
    with EmbeddedRedis(tmp_path / "redis") as server:
        connection = connect(server.url)

        def wait_for(samples: int) -> None:
            deadline = time.monotonic() + 60
            while consumed_samples(connection, [SCENE_ID]) != samples:
                assert time.monotonic() < deadline
                time.sleep(0.01)

        connection.set(f"rq:photonfarm:consumed:{SCENE_ID}", 7)
        with service._consumption_told(server.url, SCENE_ID) as used:
            time.sleep(0.3)
            wait_for(7)  # of the session before: this one knows nothing yet
            used({"kind": "train", "draws": 40, "samples": 100})
            wait_for(40)
            used({"kind": "end"})
            connection.flushall()
            wait_for(40)
            used({"kind": "train", "draws": 400, "samples": 100})
            wait_for(100)


@pytest.mark.parametrize("url", [None, "redis://127.0.0.1:1/0", "nonsense"])
def test_without_a_redis_training_goes_on(url: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service, "TELL_S", 0.01)
    with service._consumption_told(url, SCENE_ID) as used:
        used({"kind": "train", "draws": 1, "samples": 1})
        time.sleep(0.1)
