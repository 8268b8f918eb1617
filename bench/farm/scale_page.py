"""The page on what breaks first: the table of costs with their exponents, and the order in which they pass limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bench.farm.scale_costs import TARGETS, Axis, Cost, Grown, first_to_break
from bench.farm.scale_store import FAILED, SHARD_ROWS, SPEC
from bench.farm.scale_workers import COMMITTED, JOB_S
from bench.harness import results

ORDERED: tuple[Axis, ...] = ("samples", "workers", "plans")
SOON = 4
"""How many of the costs below their limits are named as the next to pass them."""

SAMPLE_BYTES = 1.0e6
"""A sample with its guides, as docs/results/store.md has it for `room`: 0.8 to 1.7 MB."""


def page(now: Sequence[Grown], before: Mapping[Cost, Grown], commit: str, kept: Mapping[str, str] | None = None) -> str:
    """The page; `before` are the same costs at an earlier commit, and `kept` the commits of what was not measured anew.

    The latter are by step.
    """
    tables = "\n\n".join(_table(axis, now, before) for axis in ORDERED if any(e.cost.axis == axis for e in now))
    product = f"the product at commit {commit.partition(' ')[0]}, measured by this bench"
    earlier = (
        f"\nThe figures in brackets are from before [the improvements below](#improved): {product}." if before else ""
    )
    return f"""# What breaks first

Think of a farm with ten million samples (10 TB of `{SPEC}`), a thousand workers and a thousand plans. Which cost passes
its limit first? Each cost is measured at sizes that fit this machine, fitted by constant + factor · size ^ exponent,
and extrapolated. Its *limit* is our choice, with the reason beside it; *reached at* is the size where the cost passes
it.{earlier}

{_verdict(now, before)}

{tables}

Processor seconds are of one core of this machine, which others used as well; operations are counted. Exponents have
their 95 % interval. Where a cost is all but constant over the sizes, its mean is given.

Stores over samples are of `{SPEC}`, in jobs of {SHARD_ROWS}, without guides (with them, there is a second folder of
markers, and listings are twice as long); the last twentieth of the jobs is missing, and {FAILED} others, as if they had
failed. Their markers come from a generator, in the format of a commit, and the shards that they name are not there.
What a worker reads grows up to a chunk of 65 536 rows of each input, which the smallest stores do not fill, and no
further. Requests to a bucket are counted on the way to a real S3 server of this machine.

Workers are real ones (queue, heartbeat, commit, markers), many to a process, whose images of 8 × 8 pixels take
{JOB_S:g} s a job, asleep; at the end all of them wait for a job that somebody else holds, in a store of {COMMITTED}
jobs and more. Commands include those within scripts.

## Files

{_files()}

{IMPROVED}{_kept(kept or {})}"""


def _kept(kept: Mapping[str, str]) -> str:
    """The commits at which the kept steps were measured."""
    steps: dict[str, list[str]] = {}
    for step, commit in kept.items():
        steps.setdefault(commit, []).append(step)
    told = [f"{', '.join(each)} at {commit}" for commit, each in steps.items()]
    return f"\n\nMeasured earlier: {'; '.join(told)}." if told else ""


def _verdict(now: Sequence[Grown], before: Mapping[Cost, Grown]) -> str:
    """Which costs pass their limits first, now and before."""
    lines = []
    for title, broken in (("Now", first_to_break(now)), ("Before", first_to_break(list(before.values())))):
        if title == "Before" and not before:
            continue
        named = [f"{i}. {_told(each)}" for i, each in enumerate(broken, 1)]
        lines.append(
            f"**{title}**, {len(named)} costs were above their limits, ordered by the size where they reach them:\n\n"
            + "\n".join(named)
            if named
            else f"**{title}**, every cost is below its limit. The next to reach it:\n\n{_next(now)}"
        )
    return "\n\n".join(lines)


def _next(costs: Sequence[Grown]) -> str:
    """The costs below their limits that reach them first."""
    soon = sorted(costs, key=lambda each: each.room)[:SOON]
    return "\n".join(f"{i}. {_told(each)}" for i, each in enumerate(soon, 1))


def _told(each: Grown) -> str:
    cost = each.cost
    return (
        f"{cost.about}: at {_size(each.breaks_at)} {cost.axis}; {_value(each.at_target, cost)} at "
        f"{_size(TARGETS[cost.axis])}, limit {_value(cost.limit, cost)}"
    )


def _table(axis: Axis, now: Sequence[Grown], before: Mapping[Cost, Grown]) -> str:
    largest = max(max(each.sizes) for each in now if each.cost.axis == axis)
    header = [
        f"cost over {axis}", f"at {_size(largest)}", "exponent", f"at {_size(TARGETS[axis])}", "limit", "reached at"
    ]  # fmt: skip
    rows = []
    for each in now:
        if each.cost.axis != axis:
            continue
        was = before.get(each.cost)
        cells = [
            now_ if was is None else f"{now_} ({was_})"
            for now_, was_ in zip(_cells(each), _cells(was or each), strict=True)
        ]
        limit = f"{_value(each.cost.limit, each.cost)}: {each.cost.why}"
        rows.append([each.cost.about, *cells[:3], limit, cells[3]])
    return results.table(header, rows)


def _cells(each: Grown) -> list[str]:
    """The cost at the largest size, its exponent, the cost at the target, and the size where it reaches its limit."""
    at_largest, at_target = _value(each.values[-1], each.cost), _value(each.at_target, each.cost)
    return [at_largest, str(each.growth), at_target, _size(each.breaks_at)]


def _value(value: float, cost: Cost) -> str:
    number = value / 1e6 if cost.unit == "MB" else value
    digits = 0 if number >= 100 else 1 if number >= 10 else 2 if number >= 1 else 4
    text = f"{number:,.{digits}f}".rstrip("0").rstrip(".") if digits else f"{number:,.0f}"
    return f"{text or '0'} {cost.unit}".strip() if cost.unit != "/s" else f"{text or '0'}/s"


def _size(size: float) -> str:
    if size == float("inf") or size > 1e15:
        return "never"
    if size < 1e4:
        return f"{size:,.0f}"
    mantissa, _, exponent = f"{size:.1e}".partition("e")
    return f"{mantissa.removesuffix('.0')}·10^{int(exponent)}"


def _files() -> str:
    """The number of files and names, computed from the arrays that a scene has."""
    from photonfarm.scene.spec_loading import NamedSpec
    from photonfarm.store.format import schema

    spec = NamedSpec.load(SPEC).spec
    outputs = len(schema.output_arrays(spec)) - 1  # radiance_wide is rare
    rows = []
    for shard_rows in (8, 32, 256, 4096):
        jobs = TARGETS["samples"] / shard_rows
        files = jobs * (outputs + 1)
        size = SAMPLE_BYTES * shard_rows
        rows.append([shard_rows, f"{jobs:,.0f}", f"{files:,.0f}", f"{size / 1e6:,.0f} MB", f"{jobs / 1000:,.0f}"])
    header = [
        "samples of a job", "jobs; names in a folder of markers, and of an array", "files", "bytes of a job",
        "LISTs for all markers",
    ]  # fmt: skip
    return f"""A job of `{SPEC}` is {outputs} shards and a marker.
{TARGETS["samples"]:,.0f} samples of about {SAMPLE_BYTES / 1e6:g} MB are then:

{results.table(header, rows)}

ext4 holds some ten million names of this length in a folder (without `large_dir`), and by default one file for each
16 kB of its size. `--shard-rows` sets the samples of a job, in a scene's first plan."""


IMPROVED = """## Improved

None of this changes the store's format, or what a commit guarantees; each has a test that counts operations.

- **Waiting workers.** Each idle worker listed all markers every two seconds, and read all of Redis' keys three to nine
  times: listings by workers × markers, and commands that grew faster than the workers. Now one looks, and Redis keeps
  for two seconds what it found (`queue.look`). When nothing is left, every worker that ends with its work looks once
  more for itself. (`test_queue_look.py`)
- **Looks at a bucket.** Each look listed every marker, a request per thousand. Now it asks for the few that are missing
  among the first ones, and lists what lies behind (`FollowedMarkers`); all are listed again every ten minutes, or when
  something cannot be read. (`test_followed_markers.py`)
- **Looks in a folder** still list everything, and so does the arithmetic on all rows after news. Trainers, and workers
  with `--ahead` or `--share`, now wait twenty times as long as a look took, a minute at most: from some 10^6 samples on
  that is longer than before, and looks take a twentieth of the time. (`test_dataset.py`, `test_trainer_pace.py`)

## Not improved, and not measured

- `status`, and the first look of `web` and `serve-metrics`, read every marker: linear, and in a bucket 312,500 requests
  at 10 million samples, eight at a time.
- Each submission loads all earlier plans, to plan nothing twice: linear each, so that many small ones are quadratic in
  all. Submit much at a time.
- Filling the queue lists every marker, once for each 10,000 jobs that are queued; at 10 million samples 32 times.
- A worker that serves one scene (`--scene`) or leaves some makes Redis pass over the queued jobs of others, at most
  10,000 names each time it asks; a queue full of them is slow for hundreds of such workers.
- A trainer keeps Python's sets and lists of row numbers: not measured here, some gigabytes at 10 million samples.
- The reading of 10 TB itself, a file server, and S3's own limits: no such machines were at hand."""
