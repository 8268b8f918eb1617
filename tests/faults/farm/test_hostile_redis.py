"""A stranger who can write to Redis wants more than that, and gets nothing; each attack works on a plain RQ worker.

All attacks lie in the same queue, each under the name of an honest job or beside it. Plain RQ workers, of either
serializer, meet them first; then a worker of ours, which renders every honest job meanwhile.
"""

import http.server
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import pytest
import redis
from rq.command import PUBSUB_CHANNEL_TEMPLATE, send_kill_horse_command, send_shutdown_command
from rq.job import Callback, Job
from rq.registry import ScheduledJobRegistry
from rq.serializers import JSONSerializer
from rq.webhook import Webhook

from photonfarm.shared.farm.redis_server import EmbeddedRedis
from photonfarm.shared.plan.request import Request
from photonfarm.shared.queue import ALIVE, QUEUE, connect, job_name, open_queue, queue_status, reconcile
from photonfarm.shared.store import SceneStore, Store

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="asks /proc for the memory of processes")

LARGE = 200 << 20
KEY = f"rq:queue:{QUEUE}"
PASSWORD = "hunter2-and-more"

PROOF = """
import os
from pathlib import Path

def mark(name, *_, **__):
    with Path(os.environ["PROOF"], name).open("a") as file:
        file.write("x")

def mark_and_fail(name):
    mark(name)
    raise ValueError(name)

def on_success(*_): mark("success callback")
def on_failure(*_): mark("failure callback")

class Mark:
    @classmethod
    def of_class(cls, name): mark(name)
"""

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


class Reduced:
    """Unpickled, it runs a command."""

    def __init__(self, command: str) -> None:
        self._command = command

    def __reduce__(self) -> tuple[object, ...]:
        return (os.system, (self._command,))


@dataclass
class Field:
    """The place where it happens."""

    scene: SceneStore
    folder: Path
    url: str  # of the administrator, and the stranger
    webhook_url: str
    hits: list[str]
    proofs: dict[str, set[str]] = field(default_factory=dict)  # by who was attacked
    counts: dict[str, int] = field(default_factory=dict)  # how often a plain worker ran what is repeated
    plain_bytes: int = 0  # memory at its peak

    def collect(self, who: str) -> None:
        folder = self.folder / "proof"
        self.proofs[who] = {path.name for path in folder.iterdir()} | set(self.hits)
        for path in folder.iterdir():
            self.counts[path.name] = max(self.counts.get(path.name, 0), path.stat().st_size)
            path.unlink()
        self.hits.clear()

    def touch(self, name: str) -> str:
        return f"touch '{self.folder / 'proof' / name}'"


class Stranger:
    """Writes what a plain RQ client writes, and what it does not, under the names of honest jobs in turn."""

    def __init__(self, where: Field, connection: redis.Redis) -> None:
        self._where = where
        self._connection = connection
        self._number = -1

    def _honest(self) -> str:
        self._number += 1
        return job_name(self._where.scene.scene_id, self._number)

    def _job(self, function: str, *args: object, name: str = "", **options: object) -> Job:
        """A job that a plain worker runs, in the place of an honest one."""
        job = Job.create(
            function, args=args, id=name or self._honest(), connection=self._connection, serializer=JSONSerializer,
            origin=QUEUE, **options,
        )  # fmt: skip
        job.save()
        if name:
            self._connection.rpush(KEY, name)
        return job

    def attack_json(self) -> None:
        """All that works on a worker with JSON."""
        touch = self._where.touch
        self._job("os.system", touch("function"))
        self._job("os.system", touch("stranger"), name="a-stranger")
        self._job("proof.Mark.of_class", "class method")
        self._job("proof.mark", "x", on_success=Callback("proof.on_success"))
        self._job("proof.mark_and_fail", "x", on_failure=Callback("proof.on_failure"))
        self._job("proof.mark", "x", webhooks=[Webhook(self._where.webhook_url, "finished")])
        for name, attribute in (("proof.mark", "repeats_left"), ("proof.mark_and_fail", "retries_left")):
            job = self._job(name, attribute)
            setattr(job, attribute, 2)
            job.repeat_intervals = [0]
            job.save()
        parent = self._job("proof.mark", "x")
        self._connection.sadd(parent.dependents_key, "dependent")
        Job.create(
            "os.system", args=[touch("dependent")], id="dependent", connection=self._connection, origin=QUEUE,
            serializer=JSONSerializer, depends_on=parent.id,
        ).save()  # fmt: skip
        scheduled = Job.create(
            "os.system", args=[touch("scheduled")], id="scheduled", connection=self._connection, origin=QUEUE,
            serializer=JSONSerializer,
        )  # fmt: skip
        scheduled.save()
        self._connection.zadd(ScheduledJobRegistry(QUEUE, self._connection).key, {scheduled.id: 1})
        self.oversized(self._honest())

    def oversized(self, name: str) -> None:
        """Made inside Redis, past the limit of what may be sent."""
        self._connection.eval(
            f"local large = string.rep(string.rep('x', 1048576), {LARGE >> 20}) "
            f"redis.call('HSET', KEYS[1], 'data', large, 'origin', '{QUEUE}')",
            1, f"rq:job:{name}",
        )  # fmt: skip

    def attack_pickle(self) -> None:
        """All that works on a worker with RQ's default, pickle."""
        for field_name in ("data", "result", "meta"):
            evil = pickle.dumps(Reduced(self._where.touch(f"pickled {field_name}")))
            key = f"rq:job:{self._honest()}"
            self._connection.hset(key, mapping={"data": zlib.compress(pickle.dumps(("os.getcwd", None, (), {})))})
            self._connection.hset(key, mapping={field_name: evil, "origin": QUEUE})
        method = pickle.dumps(("touch", self._where.folder / "proof" / "method", (), {}))
        self._connection.hset(f"rq:job:{self._honest()}", mapping={"data": zlib.compress(method), "origin": QUEUE})

    def attack_ours(self) -> None:
        """What can only be aimed at us: names, our own keys, RQ's switches."""
        self._connection.lpush(
            KEY, "../../escaped-0", "/tmp/escaped-1", f"{'.' * 32}-0", "", b"\x80\x04\xff", "0" * 999
        )
        other = "0123456789abcdef" * 2
        self._connection.rpush(KEY, f"{other}-0", job_name(self._where.scene.scene_id, 10**6))
        self._connection.hset(f"rq:job:{self._honest()}", mapping={"data": zlib.compress(b"0" * LARGE)})
        self._connection.set("rq:suspended", 1)
        self._connection.set(f"rq:photonfarm:failed:../../{other}-0", "x")
        self._connection.set("rq:photonfarm:worker:evil", "")
        self._connection.zadd(f"rq:executions:{self._honest()}", {"evil": 2e9})
        self._connection.set("rq:clean_registries:photonfarm", 1)
        self._connection.set("rq:photonfarm:store", "ab" * 16)
        self._connection.set("rq:photonfarm:paused:\x1b]0;owned\x07", "\x1b]0;owned\x07")


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
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedRedis]:
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as running:
        connection = redis.Redis.from_url(running.url)
        connection.config_set("appendonly", "no")  # what is oversized need not go to the disk as well
        yield running


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


def limited_url(connection: redis.Redis, url: str) -> str:
    """A user with the permissions of the compose file."""
    script = (Path(__file__).parents[3] / "docker/redis.sh").read_text()
    (line,) = [line for line in script.splitlines() if line.startswith("user photonfarm ")]
    rules = [rule for rule in line.split()[2:] if not rule.startswith("#")]
    connection.execute_command("ACL", "SETUSER", "photonfarm", "reset", f">{PASSWORD}", *rules)
    return url.replace("unix://", f"unix://photonfarm:{PASSWORD}@")


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


# ---------------------------------------------------------------------------------- what would stop the refill for good

LONG_KEYS, LONG = 100, 1_000_000

SMALL_ENTRIES = {
    "a stranger among the workers": ("SADD", f"rq:workers:{QUEUE}", "evil"),
    "a queue that is none": ("SET", KEY, "x"),
    "taken jobs that are none": ("SET", f"{KEY}:intermediate", "x"),
    "running jobs that are none": ("SET", f"rq:wip:{QUEUE}", "x"),
    "failed jobs that are none": ("SET", f"rq:failed:{QUEUE}", "x"),
    "workers that are none": ("SET", f"rq:workers:{QUEUE}", "x"),
    "all workers that are none": ("SET", "rq:workers", "x"),
    "queues that are none": ("SET", "rq:queues", "x"),
    "a lock for ever": ("SET", "rq:photonfarm:reconcile", "x"),
    "a store for ever": ("SET", "rq:photonfarm:store", "ab" * 16),
    "taken jobs that are no text": ("RPUSH", f"{KEY}:intermediate", b"\xff"),
}


@pytest.fixture
def store(analytic: ModuleType, tmp_path: Path) -> Store:
    """A store with a scene of 3 jobs."""
    store = Store(tmp_path / "store", create=True)
    store.plan(analytic.small_spec(), Request(modifications=3), shard_rows=1)
    return store


@pytest.mark.parametrize("entry", SMALL_ENTRIES.values(), ids=SMALL_ENTRIES.keys())
def test_one_entry_does_not_stop_the_refill_nor_do_so_after_a_restart(
    store: Store, tmp_path: Path, entry: tuple[str | bytes, ...]
) -> None:
    """Strangers who have the password may do as much as we may do ourselves."""
    with EmbeddedRedis(tmp_path / "redis") as running:
        administrator = connect(running.url)
        administrator.config_set("appendfsync", "always")
        connect(limited_url(administrator, running.url)).execute_command(*entry)
        os.kill(running.pid, signal.SIGKILL)
        os.waitid(os.P_PID, running.pid, os.WEXITED | os.WNOWAIT)
        running.keep_running()
        administrator = connect(running.url)
        assert administrator.exists(entry[1]), "it has outlived the server"
        limited = connect(limited_url(administrator, running.url))
        assert reconcile(store, limited, wait_s=0) == 3
        assert queue_status(limited).queued == 3


def test_a_worker_renders_whatever_has_become_of_its_keys(
    store: Store, server: EmbeddedRedis, analytic: ModuleType, tmp_path: Path
) -> None:
    """Its start, its taking of jobs and their accounts meet keys of other kinds, also while it runs."""
    (scene,) = store.scenes()
    names = [job_name(scene.scene_id, job) for job in range(3)]
    with connect(server.url) as connection:
        connection.flushall()
        url = limited_url(connection, server.url)
        for command, key, value in SMALL_ENTRIES.values():
            if not connection.exists(key):
                connection.execute_command(command, key, value)
        for before in ("rq:job:", "rq:executions:", "rq:results:", "rq:photonfarm:starts:", "rq:photonfarm:failures:"):
            for name in names:
                connection.set(before + name, "x")
        with analytic.start_worker(store.root, url, analytic.command(0.3), tmp_path / "log") as running:
            analytic.wait_for(lambda: scene.committed_jobs(), 120)
            connection.delete(KEY)
            connection.set(KEY, "x")
            analytic.wait_for(lambda: scene.missing_jobs() == [], 120)
            running.terminate()
            assert running.wait(60) == 0
        assert queue_status(connection).failed == {}


def test_long_names_stay_in_redis(store: Store, server: EmbeddedRedis) -> None:
    with connect(server.url) as connection:
        connection.flushall()
        limited = connect(limited_url(connection, server.url))
        for i in range(LONG_KEYS):
            limited.set(f"{ALIVE}{i}".encode() + b"x" * (LONG - 10), 1)
        script = f"for i = 1, {LONG_KEYS} do redis.call('SADD', KEYS[1], i .. string.rep('x', {LONG})) end"
        limited.eval(script, 1, f"rq:workers:{QUEUE}")
        sent = connection.info("stats")["total_net_output_bytes"]
        assert reconcile(store, limited) == 3
        assert queue_status(limited).running == 0
        assert connection.info("stats")["total_net_output_bytes"] - sent < 100_000
        connection.flushall()
