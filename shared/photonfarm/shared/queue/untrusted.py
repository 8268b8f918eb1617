"""Reads from a Redis that strangers may write to: short names, short values, keys of the expected type.

Scripts leave longer entries in Redis. One of our keys with another type would make every command on it fail, for good,
and one that does not expire would keep its value for good; both are removed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

from redis import Redis

NAME_BYTES = 256
"""The most bytes of a key, or of a worker's name in RQ's registry: they contain names of hosts, workers and jobs."""

AT_ONCE = 1000
"""The number of keys in one request."""

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
    """The rest of every key that begins with a prefix, except keys too long to be ours."""
    scan, cursor, found = connection.register_script(_SCAN), b"0", set()
    while True:
        cursor, keys = scan(args=[cursor, f"{prefix}*"])
        found |= {key.decode(errors="replace").removeprefix(prefix) for key in keys}
        if int(cursor) == 0:
            return found


def beginnings(connection: Redis, keys: Sequence[str], size: int) -> Iterator[str]:
    """The first bytes of the strings at keys, in their order, as text; "" for a missing key or another type."""
    for some in batches(keys):
        with connection.pipeline(transaction=False) as pipeline:
            for key in some:
                pipeline.getrange(key, 0, size - 1)
            for value in pipeline.execute(raise_on_error=False):
                yield value.decode(errors="replace") if isinstance(value, bytes) else ""


def printable(text: str) -> str:
    """The text as one line without control characters, which a terminal would obey."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def remove_others(connection: Redis, kinds: Mapping[str, Kind]) -> int:
    """Remove the keys that exist with another type than required; returns how many.

    A counter is a string of at most nine digits.
    """
    keep = connection.register_script(_KEEP)
    return sum(int(keep(keys=some, args=[kinds[key] for key in some])) for some in batches([*kinds]))


def remove_lasting(connection: Redis, keys: Sequence[str], most_s: int) -> None:
    """Remove the keys that would expire later than after `most_s`, or never."""
    end = connection.register_script(_END)
    for some in batches(keys):
        end(keys=some, args=[most_s])


def forget_dead_workers(connection: Redis, of_queue: str, of_all: str) -> None:
    """Remove workers without a key, and invalid names, from RQ's registries of a queue and of all workers.

    RQ's own function fetches every entry, and reads keys that we may not read. Of a registry larger than a farm's, each
    call looks at another part.
    """
    connection.register_script(_FORGET)(keys=[of_queue, of_all])


def batches(keys: Sequence[str]) -> Iterator[Sequence[str]]:
    """The keys in batches, as many as one request should read."""
    return (keys[start : start + AT_ONCE] for start in range(0, len(keys), AT_ONCE))
