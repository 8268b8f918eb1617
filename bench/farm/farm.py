"""What a farm costs besides rendering: where a worker's time goes, and two workers against one.

    python -m bench.farm.farm [--spec room] [--jobs 10] [--rows 32] [--repetitions 4] [--quick] [--folder DIR]
        [--out DIR]

The account is kept inside a worker's child, as it is but for clocks around its parts, which takes jobs from an embedded
Redis and commits them to a store. Two workers against one are `photonfarm work --until-complete` on the same samples;
beside them the same rendering without queue and store, and computing that needs nothing but a processor, as two
processors that share a core do less than twice the work. Exit code 0.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from bench.farm.account import PARTS, Account, account
from bench.farm.pairs import Pair, pairs
from bench.harness import results
from photonfarm.plan.request import SHARD_ROWS
from photonfarm.scene.spec_loading import load_spec

QUICK = {"jobs": 8, "rows": 4, "repetitions": 1}
QUEUE_TARGET = 0.01
PAIR_TARGET = 1.85


def account_table(found: Account) -> str:
    """The parts, and below them the writer's thread, whose time is within theirs."""
    wall, cpu = sum(found.wall_s.values()), sum(found.cpu_s.values())
    lines = [
        [text, *(cells(found.wall_s[part], wall)), *(cells(found.cpu_s[part], cpu))] for part, text in PARTS.items()
    ]
    lines.append(["**all**", *cells(wall, wall), *cells(cpu, cpu)])
    lines.append(["among it: the writer's thread", "", "", *cells(found.writer_cpu_s, cpu)])
    return results.table(["part", "ms per job", "share", "processor, ms per job", "share"], lines)


def cells(seconds: float, whole: float) -> tuple[str, str]:
    return f"{1e3 * seconds:.1f}", f"{100 * seconds / whole:.2f} %"


def pair_table(found: Sequence[Pair]) -> str:
    lines = [
        [
            pair.what,
            f"{pair.one:.3f}",
            f"{pair.two:.3f}",
            f"×{pair.ratio:.2f} ({pair.ratio_from:.2f} … {pair.ratio_to:.2f})",
            f"×{pair.cpu_ratio:.2f}",
        ]
        for pair in found
    ]
    header = ["two against one", "one, per second", "two, per second", "ratio", "by processor time"]
    return results.table(header, lines)


def page(found: Account, two: Sequence[Pair], options: argparse.Namespace) -> str:
    spec = load_spec(options.spec)
    shares = sorted(100 * share for share in found.queue_shares)
    job_by_job = f"{shares[0]:.2f} … {shares[-1]:.2f} %, job by job"
    queue_share, store_share = 100 * found.share("queue"), 100 * found.share("rows", "commit")
    farm, rendering, computing = two
    return f"""# The farm

`{options.spec}` at {spec.film.width} × {spec.film.height}, 2 × {spec.transport.half_spp} samples per pixel, in jobs of
{options.rows} samples, each with a configuration of its own.

- **Queue overhead: {queue_share:.2f} %** of a worker's time passes outside its jobs ({job_by_job}).
  The target is at most {100 * QUEUE_TARGET:g} %.
- **Store overhead: {store_share:.2f} %** of a worker's time its rendering thread spends on the store.
- **Two workers** do **×{farm.ratio:.2f}** the jobs of one. The target is ×{PAIR_TARGET:g}. On this machine two
  processes that render the same without queue and store do ×{rendering.ratio:.2f} what one does, and two that only
  compute ×{computing.ratio:.2f}.

## Where a worker's time goes

Inside a worker's child, from the end of its first job to that of its last, {found.jobs} jobs later, with clocks around
the parts of the thread that renders. Apart from that, it starts in {found.start_s:.1f} s, and its first job, which
loads the scene and compiles its kernels or finds them in Dr.Jit's cache, takes {found.first_s:.1f} s. Processor time is
that of all threads while the rendering one is in a part; so the writer's thread, which writes rows while the next ones
are rendered, is spread over them.

{account_table(found)}

## Two workers

`photonfarm work --until-complete` with an embedded Redis, the same {options.jobs} jobs for one worker and for two.
What is counted are whole jobs, from when each worker has ended its first until one has ended its last. All sides
{options.repetitions} times by turns; medians. **Ratio**: of neighbouring runs, median (least … greatest). **By
processor time**: twice what work takes with one at it over what the same takes with two (a worker's jobs by
their markers, without the commit), which is the ratio if nobody had to wait: for a processor that others use, the disk,
or each other.

{pair_table(two)}"""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--spec", default="room", help="a built-in spec")
    parser.add_argument("--jobs", type=int, default=10, help="of a run")
    parser.add_argument("--rows", type=int, default=SHARD_ROWS, help="samples of a job")
    parser.add_argument("--repetitions", type=int, default=4)
    parser.add_argument("--quick", action="store_true", help="a minute, for figures that only show that it works")
    parser.add_argument("--folder", type=Path, help="on the disk to use (that of temporary files)")
    options = parser.parse_args()
    if options.quick:
        vars(options).update(QUICK)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        found = account(Path(folder, "account"), options)
        two = pairs(Path(folder), options)
    values = {"account": asdict(found), "pairs": [asdict(pair) for pair in two]}
    results.write("farm", page(found, two, options), values, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
