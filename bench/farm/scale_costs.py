"""The costs that grow with a farm, a limit for each, and the size where it is reached."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from bench.harness.growth import Growth

Axis = Literal["samples", "workers", "plans"]
Unit = Literal["s", "MB", "", "/s"]

TARGETS: dict[Axis, float] = {"samples": 1e7, "workers": 1e3, "plans": 1e3}
"""The farm that is asked about."""

LIST_PATIENCE = 10.0
"""Requests that a look each second can await: an answer takes some 0.1 s."""

S3_PER_S = 5500.0
"""Requests per second that S3 answers below one prefix, by its documentation."""

AHEAD_LOOK_S = 5.0
"""`backpressure.AHEAD_LOOK_S`: with --ahead each worker counts what is committed so often."""


@dataclass(frozen=True, slots=True)
class Cost:
    """One cost: where it is measured, and its limit."""

    step: str  # of the measurement
    name: str  # in it
    axis: Axis
    about: str
    unit: Unit
    limit: float
    why: str  # the limit is that


COSTS = (
    Cost(
        "plan",
        "core_s",
        "samples",
        "the plan of all samples in one submission: processor time",
        "s",
        600.0,
        "ten minutes for what then renders for weeks",
    ),
    Cost(
        "plan",
        "peak_bytes",
        "samples",
        "the plan of all samples in one submission: memory",
        "MB",
        16e9,
        "a usual machine",
    ),
    Cost(
        "plan_more",
        "core_s",
        "samples",
        "a later submission of 1000 samples: processor time",
        "s",
        60.0,
        "a user waits for it",
    ),
    Cost(
        "plan_more",
        "peak_bytes",
        "samples",
        "a later submission of 1000 samples: memory",
        "MB",
        8e9,
        "half a usual machine",
    ),
    Cost(
        "worker",
        "core_s",
        "samples",
        "a worker before its first job: processor time",
        "s",
        50.0,
        "1 % of the 500 jobs of 10 s of its child",
    ),
    Cost(
        "worker",
        "held_bytes",
        "samples",
        "a worker before its first job: memory it keeps",
        "MB",
        1e9,
        "as much as it renders with",
    ),
    Cost(
        "worker",
        "read_bytes",
        "samples",
        "a worker before its first job: bytes read",
        "MB",
        1e8,
        "0.1 TB for 1000 workers at once",
    ),
    Cost("ahead", "held_bytes", "samples", "a worker with --ahead: memory that it keeps", "MB", 1e9, "as above"),
    Cost(
        "ahead",
        "again_core_s",
        "samples",
        "a look of a worker with --ahead, every 5 s or less often: processor time",
        "s",
        2.5,
        "half a core",
    ),
    Cost("reconcile", "core_s", "samples", "filling an empty queue: processor time", "s", 5.0, "workers wait for it"),
    Cost(
        "reconcile",
        "again_core_s",
        "samples",
        "comparing a full queue with the store: processor time",
        "s",
        5.0,
        "as above",
    ),
    Cost("reconcile", "redis_bytes", "samples", "Redis with all that is queued: memory", "MB", 1e9, "a small server"),
    Cost("status", "core_s", "samples", "`status`: processor time", "s", 60.0, "a user waits for it"),
    Cost(
        "reader",
        "start_core_s",
        "samples",
        "a trainer's reader starts: processor time",
        "s",
        60.0,
        "once in a run of hours",
    ),
    Cost(
        "reader",
        "start_held_bytes",
        "samples",
        "a trainer's reader: memory that it keeps",
        "MB",
        8e9,
        "half a usual machine",
    ),
    Cost(
        "reader",
        "idle_core_s",
        "samples",
        "a reader's look that finds nothing new, once a second: processor time",
        "s",
        0.5,
        "half a core",
    ),
    Cost(
        "reader",
        "news_core_s",
        "samples",
        "a reader's look after a new marker: processor time",
        "s",
        0.5,
        "half a core",
    ),
    Cost("find", "core_s", "samples", "`store find` by key: processor time", "s", 60.0, "a user waits for it"),
    Cost(
        "bucket worker",
        "get",
        "samples",
        "bucket: a worker before its first job: GETs",
        "",
        1000.0,
        "a minute and a half at 0.1 s each",
    ),
    Cost(
        "bucket missing",
        "requests",
        "samples",
        "bucket: a list of all missing jobs: requests",
        "",
        300.0,
        "30 s at 0.1 s each",
    ),
    Cost(
        "bucket refresh",
        "requests",
        "samples",
        "bucket: a reader's look that finds nothing new, once a second: requests",
        "",
        LIST_PATIENCE,
        "1 s at 0.1 s each",
    ),
    Cost(
        "bucket news",
        "requests",
        "samples",
        "bucket: a reader's look after a new marker: requests",
        "",
        LIST_PATIENCE,
        "as above",
    ),
    Cost(
        "bucket pace",
        "requests",
        "samples",
        "bucket: a look of a worker with --ahead, every 5 s: requests",
        "",
        S3_PER_S * AHEAD_LOOK_S / TARGETS["workers"],
        "5500 a second in all, with 1000 workers",
    ),
    Cost(
        "workers",
        "busy_commands",
        "workers",
        "Redis while all work, jobs of 16 s: commands",
        "/s",
        50_000.0,
        "half of what one Redis answers",
    ),
    Cost(
        "workers",
        "busy_redis_core_s",
        "workers",
        "Redis while all work: its processor time, cores",
        "",
        0.5,
        "half its thread",
    ),
    Cost("workers", "memory_bytes", "workers", "Redis: memory", "MB", 1e9, "a small server"),
    Cost("workers", "busy_clients", "workers", "Redis: connections", "", 10_000.0, "its own limit"),
    Cost(
        "workers",
        "idle_commands",
        "workers",
        "Redis while all wait for the last job: commands",
        "/s",
        50_000.0,
        "half of what one Redis answers",
    ),
    Cost(
        "workers",
        "idle_redis_core_s",
        "workers",
        "Redis while all wait: its processor time, cores",
        "",
        0.5,
        "half its thread",
    ),
    Cost(
        "workers",
        "idle_listings",
        "workers",
        "listings of all markers while all wait for the last job",
        "/s",
        17.0,
        "313 requests each, 5500 a second in all",
    ),
    Cost("plans", "open_read", "plans", "a worker before its first job: files read", "", 10_000.0, "as bytes above"),
    Cost(
        "plans",
        "keys_core_s",
        "plans",
        "the keys by which 100 000 samples are held out: processor time",
        "s",
        10.0,
        "once in a run",
    ),
    Cost(
        "plans",
        "more_core_s",
        "plans",
        "a later submission of 1000 samples: processor time",
        "s",
        60.0,
        "a user waits for it",
    ),
)


@dataclass(frozen=True, slots=True)
class Grown:
    """A cost with its measurements and its growth."""

    cost: Cost
    sizes: tuple[float, ...]
    values: tuple[float, ...]
    growth: Growth

    @property
    def at_target(self) -> float:
        """The cost at the farm that is asked about."""
        return self.growth.at(TARGETS[self.cost.axis])

    @property
    def breaks_at(self) -> float:
        """The size from which on the cost is above its limit."""
        return self.growth.size_of(self.cost.limit)

    @property
    def room(self) -> float:
        """How many times the target that size is; below 1 the cost breaks the farm."""
        return self.breaks_at / TARGETS[self.cost.axis]


Measured = Mapping[str, Mapping[float, Mapping[str, float]]]
"""Values by step, size and name."""


def grown(measured: Measured) -> list[Grown]:
    """The growth of every cost that was measured at three sizes or more; what was not done at a size costs 0."""
    found = []
    for cost in COSTS:
        step = measured.get(cost.step, {})
        if not any(cost.name in values for values in step.values()):
            continue
        by_size = {size: values.get(cost.name, 0.0) for size, values in step.items()}
        positive = {size: value for size, value in by_size.items() if value > 0}
        if len(positive) >= 3:
            by_size = positive
        if len(by_size) >= 3:
            sizes = sorted(by_size)
            values = [by_size[size] for size in sizes]
            found.append(Grown(cost, tuple(sizes), tuple(values), Growth.of(sizes, values)))
    return found


def first_to_break(costs: Sequence[Grown]) -> list[Grown]:
    """The costs above their limits at the target, ordered by the size where they reach them."""
    return sorted((each for each in costs if each.room < 1), key=lambda each: each.room)
