"""What breaks first as a farm grows to 10 million samples, a thousand workers and 10 TB. Nothing is rendered.

    python -m bench.farm.scale [--samples N …] [--workers N …] [--bucket N …] [--plans N …]
                               [--before FILE] [--kept FILE …] [--folder DIR] [--out DIR]

Stores, plans, queue, workers, Redis and S3 server are real. Markers of most jobs come from a generator, and workers
commit images of 8 × 8 pixels that cost nothing. Costs are fitted over sizes that fit this machine, and extrapolated.
`--before` names the figures of an earlier run, to be set beside these; `--kept` those that stand for what is not
measured now (with `--samples --bucket --plans`, say, all but the workers). Exit code 0.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from bench.farm import scale_bucket, scale_plans, scale_store, scale_workers
from bench.farm.scale_costs import Measured, grown
from bench.farm.scale_page import page
from bench.harness import results
from photonfarm.farm.redis_server import EmbeddedRedis

SAMPLES = (10_000, 31_600, 100_000, 316_000, 1_000_000)
BUCKET = (64_000, 160_000, 400_000, 1_000_000)
WORKERS = (4, 16, 64, 256)
PLANS = (4, 16, 64)

BEFORE = results.FOLDER / "scale_before.json"


Found = dict[str, dict[float, dict[str, float]]]


def store(size: int, folder: Path, found: Found) -> None:
    with EmbeddedRedis(folder / "redis") as server:
        for step, costs in scale_store.in_processes(folder, size, server.url):
            found[step][size] = costs


def bucket(size: int, folder: Path, found: Found) -> None:
    for step, costs in scale_bucket.measured(folder, size).items():
        found[f"bucket {step}"][size] = costs


def plans(size: int, folder: Path, found: Found) -> None:
    found["plans"][size] = scale_plans.measured(folder, size)


def workers(size: int, folder: Path, found: Found) -> None:
    found["workers"][size] = scale_workers.measured(folder, size)


MEASURED: dict[str, Callable[[int, Path, Found], None]] = {
    "samples": store, "bucket": bucket, "plans": plans, "workers": workers,
}  # fmt: skip


def measure(options: argparse.Namespace) -> Found:
    """Every measurement, each in a folder of its own: values by step, size and name."""
    found: Found = defaultdict(dict)
    for name, measured in MEASURED.items():
        for size in getattr(options, name):
            with tempfile.TemporaryDirectory(dir=options.folder, prefix=f"scale-{name}-") as folder:
                measured(size, Path(folder), found)
            print(f"{name}: {size} measured", file=sys.stderr, flush=True)
    return dict(found)


def kept(options: argparse.Namespace) -> tuple[Found, dict[str, str]]:
    """What of the figures in --kept is not measured now, and at which commit each step was measured.

    A step is taken from the first file that has it.
    """
    now = {name for name in MEASURED if getattr(options, name)}
    found: Found = {}
    commits: dict[str, str] = {}
    for file in options.kept:
        earlier, commit = read(file)
        known = json.loads(file.read_text(encoding="utf-8")).get("kept_from_commits", {})
        for step, sizes in earlier.items():
            if part_of(step) not in now and step not in found:
                found[step] = {size: dict(values) for size, values in sizes.items()}
                commits[step] = known.get(step, commit)
    return found, commits


def part_of(step: str) -> str:
    """The name in MEASURED of what measures a step."""
    return "bucket" if step.startswith("bucket ") else step if step in MEASURED else "samples"


def read(file: Path) -> tuple[Measured, str]:
    """The measurements of an earlier run, and the commit that it was made at."""
    document = json.loads(file.read_text(encoding="utf-8"))
    measured = {
        step: {float(size): values for size, values in sizes.items()} for step, sizes in document["measured"].items()
    }
    return measured, document["commit"]


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--samples", type=int, nargs="*", default=SAMPLES)
    parser.add_argument("--bucket", type=int, nargs="*", default=BUCKET, help="samples of stores in a bucket")
    parser.add_argument("--plans", type=int, nargs="*", default=PLANS)
    parser.add_argument("--workers", type=int, nargs="*", default=WORKERS)
    parser.add_argument("--before", type=Path, default=BEFORE, help="figures of an earlier run (scale_before.json)")
    parser.add_argument(
        "--kept", type=Path, nargs="*", default=(), help="figures of earlier runs, for what is not measured now"
    )
    parser.add_argument("--folder", type=Path, help="for the stores, which are removed (a temporary one)")
    options = parser.parse_args()
    known, commits = kept(options)
    measured = {**known, **measure(options)}
    now = grown(measured)
    earlier = read(options.before) if options.before.exists() else None
    before = {each.cost: each for each in grown(earlier[0])} if earlier else {}
    values = {"kept_from_commits": commits, "measured": measured, "growth": [asdict(each) for each in now]}
    results.write("scale", page(now, before, earlier[1] if earlier else "", commits), values, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
