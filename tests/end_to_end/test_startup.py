"""Verbs start soon: none loads a package that it does not need, and Ctrl-C ends those that measure at once."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import redis

from photonfarm.farm.redis_server import EmbeddedRedis
from photonfarm.farm.submission import submit
from photonfarm.plan.request import Request
from photonfarm.scene.spec_loading import NamedSpec

MOST_CPU_S = 1.2
"""The most processor time of a start: three times what it takes on a quiet machine."""

HEAVY = {"torch", "mitsuba", "drjit", "zarr", "scipy", "matplotlib", "trimesh", "obstore"}

CODE = """
import json, sys
from photonfarm.cli.main import main
try:
    main(sys.argv[1:])
finally:
    print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})), file=sys.stderr)
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("startup") / "store"
    submit(NamedSpec.load("room"), folder, None, Request(modifications=3))
    return folder


@pytest.mark.parametrize(
    ("command", "needless"),
    [
        (["--help"], HEAVY | {"numpy", "redis", "rq"}),
        (["submit", "--help"], HEAVY | {"numpy", "redis", "rq", "pydantic"}),
        (["train", "--help"], HEAVY | {"numpy", "redis", "rq"}),
        (["scene", "show", "room"], HEAVY | {"redis", "rq"}),
        (["status"], HEAVY - {"zarr"} | {"redis", "rq"}),  # nothing listens there
        (["store", "find"], HEAVY - {"zarr"} | {"redis", "rq"}),
        (["submit", "room", "--dry-run", "--no-measure"], HEAVY - {"zarr"}),
        (["slurm", "cornell", "--no-queue", "--dry-run"], HEAVY),
    ],
)
def test_a_verb_loads_only_what_it_needs_and_starts_soon(store: Path, command: list[str], needless: set[str]) -> None:
    environment = {**os.environ, "PHOTONFARM_STORE": str(store), "PHOTONFARM_REDIS_URL": "redis://127.0.0.1:1/0"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-c", CODE, *command], capture_output=True, text=True, check=False, env=environment
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    assert needless.isdisjoint(json.loads(done.stderr.splitlines()[-1]))
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < MOST_CPU_S


def test_status_with_a_redis_loads_only_what_it_needs(
    store: Path, common_redis: EmbeddedRedis, connection: redis.Redis
) -> None:
    environment = {**os.environ, "PHOTONFARM_STORE": str(store), "PHOTONFARM_REDIS_URL": common_redis.url}
    command = [sys.executable, "-c", CODE, "status"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert "0 jobs queued" in done.stdout
    assert (HEAVY - {"zarr"}).isdisjoint(json.loads(done.stderr.splitlines()[-1]))


def test_garbage_is_collected_again_after_loading() -> None:
    code = """
import gc
from photonfarm.cli.options import StorePlace
StorePlace().convert("store", None, None)
print(gc.isenabled(), gc.get_freeze_count() > 0)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"]


@pytest.mark.usefixtures("hears_ctrl_c")
@pytest.mark.parametrize(("verb", "code"), [(["scene", "plan"], -signal.SIGINT), (["submit", "--dry-run"], 130)])
def test_ctrl_c_ends_a_measurement_within_two_seconds(tmp_path: Path, verb: list[str], code: int) -> None:
    command = [sys.executable, "-m", "photonfarm.cli", *verb, "cornell"]
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as measuring:
        assert measuring.stderr is not None
        line = measuring.stderr.readline()
        while "following" not in line and "measuring" not in line:  # loaded; from here on, kernels compile and run
            line = measuring.stderr.readline()
            assert line
        time.sleep(0.5)
        os.killpg(measuring.pid, signal.SIGINT)
        assert measuring.wait(2) == code
    assert list(tmp_path.iterdir()) == [], "nothing is kept of half a measurement"
