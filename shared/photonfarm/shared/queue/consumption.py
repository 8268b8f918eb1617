"""The trainer's reports to the workers of how many samples of a scene it has used, so that they need not run far ahead.

The number is reported repeatedly, so a Redis that lost it has it again within seconds.
"""

from __future__ import annotations

from collections.abc import Sequence

from redis import Redis

CONSUMED = "rq:photonfarm:consumed:"
CONSUMED_TTL_S = 7 * 86400
"""How long workers wait for a trainer that is down or has ended, as the ratio demands."""


def report_consumed(connection: Redis, scene_id: str, samples: int) -> None:
    """Report how many samples of a scene have been used, each counted once."""
    connection.set(CONSUMED + scene_id, samples, ex=CONSUMED_TTL_S)


def consumed_samples(connection: Redis, scene_ids: Sequence[str]) -> dict[str, int]:
    """How many samples of each of these scenes its trainer has used, by its last report; 0 without one."""
    counts = connection.mget([CONSUMED + scene_id for scene_id in scene_ids]) if scene_ids else []
    return {scene_id: int(samples or 0) for scene_id, samples in zip(scene_ids, counts, strict=True)}
