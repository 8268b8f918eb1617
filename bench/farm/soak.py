"""A long soak: workers, Redis and submitters are killed, stopped and made to forget at random, while a reader looks on.

    python -m bench.farm.soak [--share 1] [--workers 3] [--seed 1] [--out DIR]

The one of tests/faults/soaking.py, whose short form is among the tests; `--share 0.1` does a tenth of it. Exit code 0
if all that must hold held. What does not hold on the way ends it at once; what does not in the end is printed
line by line.
"""

from __future__ import annotations

import importlib
import sys
import tempfile
from dataclasses import asdict
from math import ceil
from pathlib import Path
from typing import Any

from bench.harness import results

JOBS = 1000
KILLS = 150
SUPERVISOR_KILLS = 20
RACES = 20
REDIS_KILLS = 5
LONG_OUTAGE_S = 40.0
FLUSHES = 3
SUBMITTERS = 4
PAUSE_S = 0.05  # for each half of a sample: a job takes some tenths of a second, and kills meet it at work
PACE_S = (0.4, 1.6)  # between one thing and the next


def page(found: Any, workers: int, outage_s: float) -> str:
    toll = found.toll
    rows = [
        ["jobs", found.jobs],
        ["samples", found.samples],
        ["workers' children killed (SIGKILL) with a job in hand", toll.kills],
        ["supervisors killed (SIGKILL), whose child then ended itself, and started again", toll.supervisor_kills],
        ["workers' children stopped (SIGSTOP) with a job in hand", toll.stops],
        ["of these: went on (SIGCONT), and found that job committed by another worker", toll.races],
        ["Redis killed (SIGKILL)", toll.redis_kills],
        ["FLUSHALL", toll.flushes],
        ["pairs of submitters at once", toll.submitters],
        ["samples read and compared meanwhile", found.reads],
        ["seconds", f"{found.seconds:.0f}"],
        ["differences", len(found.differences)],
    ]
    return f"""# Soak

{workers} workers render a plan by formulas, each half in {PAUSE_S:g} s, while all of this happens in random order;
Redis is away for {outage_s:g} s once. A difference would be a job that is not committed, or twice: its marker is not,
byte for byte, the one that was seen first, or two children say that they have committed it; a sample that a reader
beside it all was not shown, or not whole, or that changed or went; a file that is not, byte for byte, what an
undisturbed worker writes; a row that zarr-python reads otherwise than our reader does; a file left half-written.

{results.table(["", "count"], rows)}"""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of all the counts")
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    sys.path.insert(0, str(results.ROOT / "tests/faults"))
    soak = importlib.import_module("soaking")
    jobs, kills, supervisor_kills, races, redis_kills, flushes, submitters = (
        ceil(options.share * count)
        for count in (JOBS, KILLS, SUPERVISOR_KILLS, RACES, REDIS_KILLS, FLUSHES, SUBMITTERS)
    )
    outage_s = LONG_OUTAGE_S * min(1.0, options.share)
    wanted = soak.Toll(
        kills=kills,
        supervisor_kills=supervisor_kills,
        races=races,
        redis_kills=redis_kills,
        flushes=flushes,
        submitters=submitters,
    )
    with tempfile.TemporaryDirectory() as folder:
        found = soak.Soak(Path(folder), jobs=jobs, workers=options.workers, pause_s=PAUSE_S, seed=options.seed).run(
            wanted, pace_s=PACE_S, long_outage_s=outage_s
        )
    results.write("soak", page(found, options.workers, outage_s), asdict(found), options.out, page="farm")
    for difference in found.differences:
        print(difference, file=sys.stderr)
    return 1 if found.differences else 0


if __name__ == "__main__":
    sys.exit(main())
