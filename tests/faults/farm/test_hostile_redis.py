"""A stranger who can write to Redis wants more than that, and gets nothing; each attack works on a plain RQ worker.

All attacks lie in the same queue, each under the name of an honest job or beside it. Plain RQ workers, of either
serializer, meet them first; then a worker of ours, which renders every honest job meanwhile.
"""

import http.server
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import redis
from redis_stranger import KEY, LARGE, PASSWORD, PROOF, Field, Stranger, limited_url
from rq.command import PUBSUB_CHANNEL_TEMPLATE, send_kill_horse_command, send_shutdown_command

from photonfarm.shared.farm.redis_server import EmbeddedRedis
from photonfarm.shared.plan.request import Request
from photonfarm.shared.queue import ALIVE, connect, job_name, open_queue, queue_status, reconcile
from photonfarm.shared.store import Store

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="asks /proc for the memory of processes")

PLAIN = """
import resource, sys
from redis import Redis
from rq import SimpleWorker
worker = SimpleWorker(["photonfarm"], connection=Redis.from_url(sys.argv[1]), serializer=sys.argv[2])
if sys.argv[3] == "listening":
    worker.work(logging_level="INFO")
else:
    worker.work(burst=True, with_scheduler=True, logging_level="ERROR")
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""


def run_plain(where: Field, serializer: str) -> None:
    command = [sys.executable, "-c", PLAIN, where.url, serializer, "burst"]
    out = subprocess.run(command, check=True, timeout=240, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL).stdout
    where.plain_bytes = max(where.plain_bytes, int(out))
    where.collect(f"plain, {serializer}")


def peak_bytes(pid: int) -> int:
    (line,) = [line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1]) * 1024


@pytest.fixture(scope="module")
def webhooks() -> Iterator[tuple[str, list[str]]]:
    """The URL of a server and what it was asked."""
    hits: list[str] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            hits.append("webhook")
            self.send_response(204)
            self.end_headers()

        def log_message(self, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/", hits
        server.shutdown()


@pytest.fixture(scope="module")
def where(
    analytic: ModuleType,
    server: EmbeddedRedis,
    webhooks: tuple[str, list[str]],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Field]:
    """A scene of 20 jobs, all queued; what is left there once plain workers have been attacked."""
    folder = tmp_path_factory.mktemp("hostile")
    for name in ("proof", "import"):
        (folder / name).mkdir()
    (folder / "import/proof.py").write_text(PROOF)
    store = Store(folder / "store", create=True)
    scene = store.scene(store.plan(analytic.small_spec(), Request(modifications=20), shard_rows=1).scene_id)
    with pytest.MonkeyPatch.context() as patch, redis.Redis.from_url(server.url, socket_timeout=600) as connection:
        patch.setenv("PROOF", str(folder / "proof"))
        patch.setenv("PYTHONPATH", str(folder / "import"), prepend=os.pathsep)
        field_ = Field(scene, folder, server.url, *webhooks)
        for serializer in ("json", "pickle"):
            connection.flushall()
            reconcile(store, connection)
            getattr(Stranger(field_, connection), f"attack_{serializer}")()
            run_plain(field_, serializer)
        yield field_


JSON_ATTACKS = (
    "function", "stranger", "class method", "success callback", "failure callback", "webhook", "repeats_left",
    "retries_left", "dependent", "scheduled",
)  # fmt: skip
PICKLE_ATTACKS = ("pickled data", "pickled result", "pickled meta", "method")


@pytest.mark.parametrize("attack", JSON_ATTACKS)
def test_it_works_on_a_plain_worker_with_json(where: Field, attack: str) -> None:
    assert attack in where.proofs["plain, json"]


@pytest.mark.parametrize("attack", PICKLE_ATTACKS)
def test_it_works_on_a_plain_worker_with_pickle(where: Field, attack: str) -> None:
    assert attack in where.proofs["plain, pickle"]


def test_a_plain_worker_repeats_what_redis_says_and_loads_what_lies_there(where: Field) -> None:
    assert where.counts["repeats_left"] == 3
    assert where.counts["retries_left"] == 3
    assert where.plain_bytes > LARGE


def test_a_plain_worker_is_ended_by_a_message(
    where: Field, server: EmbeddedRedis, analytic: ModuleType, tmp_path: Path
) -> None:
    """It is sent until it works: RQ loses the signal that it becomes if that comes within a call of Redis' client.

    Its exit code is that of the signal where RQ does not handle it yet, and 0 also where its loop has failed by
    itself, which only its log tells.
    """
    log = tmp_path / "log"
    with connect(server.url) as connection, log.open("wb") as output:
        connection.flushall()
        command = [sys.executable, "-c", PLAIN, server.url, "json", "listening"]
        with subprocess.Popen(command, stdout=output, stderr=output) as process:
            try:
                analytic.wait_for(lambda: connection.pubsub_channels("rq:pubsub:*"), 120)
                (channel,) = connection.pubsub_channels("rq:pubsub:*")
                name = channel.decode().removeprefix(PUBSUB_CHANNEL_TEMPLATE % "")

                def is_ended() -> bool:
                    send_shutdown_command(connection, name)
                    time.sleep(1)
                    return process.poll() is not None

                analytic.wait_for(is_ended, 120)
            finally:
                process.kill()
    said = log.read_text()
    assert process.returncode in {0, -signal.SIGINT}, said
    before, received, _ = said.partition("Received shutdown command")
    assert received, said
    assert "unhandled exception" not in before, said


def files_of(where: Field) -> set[Path]:
    """Everything there, but the store and what is written by design."""
    ours = where.folder / "store"
    return {p for p in where.folder.rglob("*") if not p.is_relative_to(ours) and "__pycache__" not in p.parts}


def test_our_worker_renders_every_honest_job_and_gives_the_stranger_nothing(
    where: Field, server: EmbeddedRedis, analytic: ModuleType
) -> None:
    """It logs in with a password, and may do no more than in the compose file; its log does not tell the password."""
    log, before = where.folder / "log", files_of(where) | {where.folder / "log"}
    with redis.Redis.from_url(server.url, socket_timeout=600) as connection:
        connection.flushall()
        reconcile(Store(where.folder / "store"), connection)
        stranger = Stranger(where, connection)
        stranger.attack_json()
        stranger.attack_pickle()
        stranger.attack_ours()
        url = limited_url(connection, server.url)
        with analytic.start_worker(where.folder / "store", url, analytic.command(0.01), log, report_s=0.1) as running:
            analytic.wait_for(lambda: len(where.scene.committed_jobs()) >= 1, 240)
            child = analytic.child_of(running)
            for name in connection.smembers("rq:workers"):
                worker = name.decode().removeprefix("rq:worker:")
                send_shutdown_command(connection, worker)
                send_kill_horse_command(connection, worker)
                stop = json.dumps({"command": "stop-job", "job_id": job_name(where.scene.scene_id, 9)})
                assert connection.publish(PUBSUB_CHANNEL_TEMPLATE % worker, stop) == 0, "nobody listens"
            analytic.wait_for(lambda: where.scene.missing_jobs() == [], 240)
            analytic.wait_for(lambda: not connection.llen(KEY) and not connection.keys(f"{ALIVE}*"), 60)
            time.sleep(2)  # and what would come after
            assert analytic.child_of(running) == child, "the worker has lived through it"
            peak = peak_bytes(child)
            running.terminate()
            assert running.wait(60) == 0
        assert queue_status(connection).failed == {}
        assert connection.llen(open_queue(connection).key) == 0
    where.collect("ours")
    assert where.proofs["ours"] == set()
    assert files_of(where) == before
    assert peak < LARGE, f"{peak / 1e6:.0f} MB at its peak"
    said = log.read_text()
    assert PASSWORD not in said
    assert "thrown away" in said
    assert "Traceback" not in said
    assert " has no job " in said, "strangers' jobs of unknown scenes are refused aloud"
