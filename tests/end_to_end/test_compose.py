"""The compose file, run for real. It builds images and takes minutes, so it waits to be asked: make test-compose."""

import ipaddress
import json
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import s3_server

ROOT = Path(__file__).parents[2]
PROJECT = "photonfarm-test"
CONTAINER_UID = 1000

pytestmark = pytest.mark.skipif(
    os.environ.get("PHOTONFARM_TEST_COMPOSE") != "1", reason="needs a Docker engine; run by: make test-compose"
)


def compose(*args: str, data: Path, timeout: float = 1500, **environment: str) -> str:
    command = ["docker-compose"] if shutil.which("docker-compose") else ["docker", "compose"]
    return subprocess.run(
        [*command, "-p", PROJECT, *args],
        cwd=ROOT,
        env={**os.environ, "PHOTONFARM_DATA": str(data), **environment},
        check=True,
        text=True,
        timeout=timeout,
        stdout=subprocess.PIPE,
    ).stdout


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
    checkpoint = data / "run" / "checkpoint.safetensors"
    while not checkpoint.exists() and time.monotonic() < deadline:
        time.sleep(3)
    assert checkpoint.exists(), "the trainer wrote no checkpoint"
    for line in compose("ps", "-q", data=data).split():
        state = json.loads(subprocess.check_output(["docker", "inspect", line]))[0]
        assert state["State"]["Running"]
        assert state["State"]["Health"]["Status"] in ("healthy", "starting")
        assert_is_guarded(state)
    assert "NOAUTH" in compose("exec", "-T", "redis", "redis-cli", "llen", "rq:queue:photonfarm", data=data)
    password = compose("exec", "-T", "redis", "cat", "/run/photonfarm/redis_password", data=data).strip()
    assert len(password) == 64
    assert password not in compose("logs", "--no-color", data=data)
    assert password not in compose("exec", "-T", "redis", "sh", "-c", "cat /proc/[0-9]*/cmdline", data=data)
    (port,) = s3_server.free_ports(1)
    compose("--profile", "web", "up", "-d", "web", data=data, PHOTONFARM_WEB_PORT=str(port))
    assert "<title>photonfarm" in fetched(f"http://localhost:{port}/", deadline)
    metrics = fetched(f"http://localhost:{port}/metrics", deadline)
    assert 'photonfarm_samples_committed_total{pass="first",scene="room"' in metrics


def fetched(url: str, deadline: float) -> str:
    """What a page says, as soon as its server answers."""
    while True:
        try:
            with urllib.request.urlopen(url, timeout=20) as answer:
                return answer.read().decode()
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(1)


def assert_is_guarded(container: dict[str, Any]) -> None:
    """It runs as nobody in particular, writes to nothing but its volumes and /tmp, and nobody outside reaches it."""
    host = container["HostConfig"]
    assert container["Config"]["User"].split(":")[0] in (str(CONTAINER_UID), "redis")
    assert host["ReadonlyRootfs"]
    assert host["CapDrop"] == ["ALL"]
    assert not host["CapAdd"]
    assert not host["Privileged"]
    assert "no-new-privileges:true" in host["SecurityOpt"]
    assert not any(container["NetworkSettings"]["Ports"].values())
    assert not [name for name in container["Config"]["Env"] if "PASSWORD=" in name]


@pytest.mark.timeout(2400)
def test_a_plan_completes_while_a_container_is_killed_every_few_seconds(
    photonfarm, data: Path, small_room: Path
) -> None:
    compose("up", "-d", "--build", "--scale", "renderer=4", "redis", "renderer", data=data)
    store = data / "store"
    request = ("--modifications", "240", "--views", "2", "--shard-rows", "4", "--no-queue", "--json")
    planned = photonfarm("submit", small_room, "--store", store, *request)
    assert planned.returncode == 0, planned.stderr
    if os.geteuid() == 0:
        subprocess.run(["chown", "-R", str(CONTAINER_UID), str(data)], check=True)
    renderers = compose("ps", "-q", "renderer", data=data).split()
    deadline, kills = time.monotonic() + 1800, 0
    while len(list(store.glob("scenes/*/committed/*.json"))) < 120 and time.monotonic() < deadline:
        time.sleep(8)
        victim = renderers[kills % len(renderers)]
        subprocess.run(["docker", "kill", victim], check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        subprocess.run(["docker", "start", victim], check=True, stdout=subprocess.DEVNULL)
        kills += 1
    (scene,) = json.loads(photonfarm("status", "--store", store, "--json").stdout)["scenes"]
    assert (scene["samples_complete"], scene["jobs_committed"]) == (480, 120)
    assert kills >= 8


@pytest.mark.timeout(2400)
def test_a_farm_with_its_store_in_a_bucket_completes_a_plan(photonfarm, data: Path, small_room: Path) -> None:
    (data / "s3").mkdir()
    bridge = json.loads(subprocess.check_output(["docker", "network", "inspect", "bridge"]))[0]
    config = bridge["IPAM"]["Config"][0]  # an engine that has just started does not name the gateway yet
    gateway = config.get("Gateway") or str(next(ipaddress.ip_network(config["Subnet"]).hosts()))  # this machine
    with s3_server.running(data / "s3", bind="0.0.0.0") as port:
        here = {**s3_server.environment(port), "PHOTONFARM_STORE": "s3://farm/store"}
        there = {**here, "AWS_ENDPOINT_URL": f"http://{gateway}:{port}"}
        files = ("-f", "docker-compose.yml", "-f", "docker-compose.bucket.yml")
        compose(*files, "up", "-d", "--build", "--scale", "renderer=2", "redis", "renderer", data=data, **there)
        request = ("--modifications", "8", "--views", "2", "--shard-rows", "4", "--no-queue", "--json")
        planned = photonfarm("submit", small_room, *request, **here)
        assert planned.returncode == 0, planned.stderr
        deadline, complete = time.monotonic() + 600, 0
        while complete < 16 and time.monotonic() < deadline:
            time.sleep(3)
            complete = json.loads(photonfarm("status", "--json", **here).stdout)["scenes"][0]["samples_complete"]
        assert complete == 16
