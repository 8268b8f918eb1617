#!/usr/bin/env python3
"""A long soak: workers, Redis and submitters are killed, stopped and made to forget at random, while a reader looks on.

    python bench/soak.py [--share 1] [--workers 3] [--seed 1] [--out DIR]

The one of tests/faults/soak.py, whose short form is among the tests; `--share 0.1` does a tenth of it. Exit code 0 if
all that must hold held; otherwise it ends with the first thing that did not.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
from dataclasses import asdict
from math import ceil
from pathlib import Path
from typing import Any

import results

JOBS = 1000
KILLS = 150
RACES = 20
REDIS_KILLS = 5
LONG_OUTAGE_S = 40.0
FLUSHES = 3
SUBMITTERS = 4
PAUSE_S = 0.05  # for each half of a sample: a job takes some tenths of a second, and kills meet it at work
PACE_S = (0.4, 1.6)  # between one thing and the next


def load_soak() -> Any:
    """The module of the tests."""
    path = Path(__file__).parents[1] / "tests/faults/soak.py"
    spec = importlib.util.spec_from_file_location("soak", path)
    if spec is None or spec.loader is None:
        raise SystemExit(f"{path}: cannot be loaded")
    module = importlib.util.module_from_spec(spec)
    sys.modules["soak"] = module  # its dataclasses look for it there
    spec.loader.exec_module(module)
    return module


def page(found: Any, workers: int, outage_s: float) -> str:
    toll = found.toll
    rows = [
        ["jobs", found.jobs],
        ["samples", found.samples],
        ["workers' children killed (SIGKILL)", toll.kills],
        ["workers' children stopped (SIGSTOP, then SIGCONT)", toll.stops],
        ["of these: finished a job that another worker had committed meanwhile", toll.races],
        ["Redis killed (SIGKILL)", toll.redis_kills],
        ["FLUSHALL", toll.flushes],
        ["pairs of submitters at once", toll.submitters],
        ["samples read and compared meanwhile", found.reads],
        ["seconds", f"{found.seconds:.0f}"],
        ["differences", 0],
    ]
    return f"""# Soak

{workers} workers render a plan by formulas, each half in {PAUSE_S:g} s, while all of this happens in random order;
Redis is away for {outage_s:g} s once. All jobs are committed, none twice; what a reader saw meanwhile was whole and
stayed; and in the end every file is, byte for byte, what an undisturbed worker writes, and zarr-python reads what our
reader does.

{results.table(["", "count"], rows)}

{results.footer("soak")}"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--share", type=float, default=1.0, help="of all the counts")
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    results.add_options(parser)
    options = parser.parse_args()
    soak = load_soak()
    jobs, kills, races, redis_kills, flushes, submitters = (
        ceil(options.share * count) for count in (JOBS, KILLS, RACES, REDIS_KILLS, FLUSHES, SUBMITTERS)
    )
    outage_s = LONG_OUTAGE_S * min(1.0, options.share)
    wanted = soak.Toll(kills=kills, races=races, redis_kills=redis_kills, flushes=flushes, submitters=submitters)
    with tempfile.TemporaryDirectory() as folder:
        found = soak.Soak(Path(folder), jobs=jobs, workers=options.workers, pause_s=PAUSE_S, seed=options.seed).run(
            wanted, pace_s=PACE_S, long_outage_s=outage_s
        )
    results.write("soak", page(found, options.workers, outage_s), asdict(found), options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
