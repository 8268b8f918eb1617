"""The compose file, run for real. It builds images and takes minutes, so it waits to be asked: make test-compose."""

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = "photonfarm-test"
CONTAINER_UID = 1000

pytestmark = pytest.mark.skipif(
    os.environ.get("PHOTONFARM_TEST_COMPOSE") != "1", reason="needs a Docker engine; run by: make test-compose"
)


def compose(*args: str, data: Path, timeout: float = 1500) -> str:
    command = ["docker-compose"] if shutil.which("docker-compose") else ["docker", "compose"]
    return subprocess.run(
        [*command, "-p", PROJECT, *args], cwd=ROOT, env={**os.environ, "PHOTONFARM_DATA": str(data)},
        check=True, text=True, timeout=timeout, stdout=subprocess.PIPE,
    ).stdout  # fmt: skip


@pytest.fixture
def data(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path
    print(compose("logs", "--no-color", "--tail", "30", data=tmp_path))
    compose("down", "-v", data=tmp_path)


@pytest.mark.timeout(2400)
def test_a_plan_submitted_from_the_host_is_rendered_by_three_workers_and_trained_on(
    photonfarm, data: Path, small_room: Path
) -> None:
    compose("up", "-d", "--build", "--scale", "renderer=3", data=data)
    store = data / "store"
    request = ("--modifications", "30", "--views", "2", "--shard-rows", "4", "--no-queue", "--json")
    planned = photonfarm("submit", small_room, "--store", store, *request)
    assert planned.returncode == 0, planned.stderr
    if os.geteuid() == 0:  # the containers' user must be able to write beside the plan
        subprocess.run(["chown", "-R", str(CONTAINER_UID), str(data)], check=True)

    deadline = time.monotonic() + 600
    scene = {"samples_complete": 0}
    while scene["samples_complete"] < 60 and time.monotonic() < deadline:
        time.sleep(3)
        (scene,) = json.loads(photonfarm("status", "--store", store, "--json").stdout)["scenes"]
    assert scene["samples_complete"] == 60

    markers = [json.loads(p.read_text()) for p in store.glob("scenes/*/committed/*.json")]
    assert len({marker["figures"]["worker"] for marker in markers}) == 3
    while not list(data.glob("run/*.pt")) and time.monotonic() < deadline:
        time.sleep(3)
    assert list(data.glob("run/*.pt")), "the trainer wrote no checkpoint"
    for line in compose("ps", "-q", data=data).split():
        state = json.loads(subprocess.check_output(["docker", "inspect", line]))[0]
        assert state["State"]["Running"]
        assert state["State"]["Health"]["Status"] in ("healthy", "starting")
        if "redis" not in state["Name"]:
            assert state["Config"]["User"].split(":")[0] == str(CONTAINER_UID)
