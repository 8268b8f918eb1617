"""What is read of a Redis that strangers may write to: short names, short values, keys of the kind that is expected.

What is too long is left in Redis, by scripts. A key of ours that has become one of another kind would make every
command on it fail, for good, as one that does not run out would hold what it holds; both are removed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

from redis import Redis

NAME_BYTES = 256
"""Of a key, or of a worker in RQ's registry, at most: a host's name, and a worker's, and a job's are in it."""

AT_ONCE = 1000
"""Keys that are asked after in one request."""

Kind = Literal["string", "counter", "list", "set", "zset", "hash", "stream"]

_SCAN = f"""
local found = redis.call('SCAN', ARGV[1], 'MATCH', ARGV[2], 'COUNT', {AT_ONCE})
local names = {{}}
for _, name in ipairs(found[2]) do
  if #name <= {NAME_BYTES} then names[#names + 1] = name end
end
return {{found[1], names}}
"""

_KEEP = """
local removed = 0
for i, key in ipairs(KEYS) do
  local kind, wanted = redis.call('TYPE', key).ok, ARGV[i]
  local fits = kind == 'none' or kind == wanted
  if wanted == 'counter' and kind == 'string' then
    fits = redis.call('STRLEN', key) <= 9 and string.find(redis.call('GET', key), '^%d+$')
  end
  if not fits then removed = removed + redis.call('UNLINK', key) end
end
return removed
"""

_END = """
for _, key in ipairs(KEYS) do
  local left_ms = redis.call('PTTL', key)
  if left_ms == -1 or left_ms > ARGV[1] * 1000 then redis.call('UNLINK', key) end
end
"""

_FORGET = f"""
for _, worker in ipairs(redis.call('SRANDMEMBER', KEYS[1], {AT_ONCE})) do
  local is_one = #worker <= {NAME_BYTES} and string.sub(worker, 1, 10) == 'rq:worker:'
  if not is_one or redis.call('EXISTS', worker) == 0 then
    redis.call('SREM', KEYS[1], worker)
    redis.call('SREM', KEYS[2], worker)
  end
end
"""


def names_below(connection: Redis, prefix: str) -> set[str]:
    """What follows a prefix in the keys that have it, without those too long to be ours."""
    scan, cursor, found = connection.register_script(_SCAN), b"0", set()
    while True:
        cursor, keys = scan(args=[cursor, f"{prefix}*"])
        found |= {key.decode(errors="replace").removeprefix(prefix) for key in keys}
        if int(cursor) == 0:
            return found


def beginnings(connection: Redis, keys: Sequence[str], size: int) -> Iterator[str]:
    """The first bytes of the strings at keys, in their order, as text; "" where there is none, or something else."""
    for some in batches(keys):
        with connection.pipeline(transaction=False) as pipeline:
            for key in some:
                pipeline.getrange(key, 0, size - 1)
            for value in pipeline.execute(raise_on_error=False):
                yield value.decode(errors="replace") if isinstance(value, bytes) else ""


def printable(text: str) -> str:
    """A line for terminals, which obey what is in it that does not print."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def remove_others(connection: Redis, kinds: Mapping[str, Kind]) -> int:
    """Remove the keys that are not of the kind they have to be, or absent; how many.

    A counter is a string of at most nine digits.
    """
    keep = connection.register_script(_KEEP)
    return sum(int(keep(keys=some, args=[kinds[key] for key in some])) for some in batches([*kinds]))


def remove_lasting(connection: Redis, keys: Sequence[str], most_s: int) -> None:
    """Remove the keys that would not run out within a time, or never."""
    end = connection.register_script(_END)
    for some in batches(keys):
        end(keys=some, args=[most_s])


def forget_dead_workers(connection: Redis, of_queue: str, of_all: str) -> None:
    """Take the workers without a key, and what is no worker's name, out of RQ's registries of a queue and of all.

    RQ's own function fetches every entry, and asks after keys that we may not ask after. Of a larger registry than a
    farm's a part is looked at, another one the next time.
    """
    connection.register_script(_FORGET)(keys=[of_queue, of_all])


def batches(keys: Sequence[str]) -> Iterator[Sequence[str]]:
    """Keys, so many at a time as one request should ask after."""
    return (keys[start : start + AT_ONCE] for start in range(0, len(keys), AT_ONCE))
