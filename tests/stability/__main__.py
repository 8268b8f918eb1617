"""Renders the 36 rows of hard scenes with `bdpt` and compares each with its truth; writes and prints the report.

    make stability ARGS="--quick --only 13 11-cove"
    python -m tests.stability [--only 13 11-cove] [--settings 1,1 0,0] [--seed 0] [--quick] [--threads 1]
        [--out stability] [--invariances [counts additive-many-lights …]]

Without --quick this is the long version. After all scenes (no --only, no --settings), or alone with --invariances, it
checks what must not change an image: technique counts, sums of lights, units, edits in place, seeds. A failure keeps
its renders under OUT/failures and prints the command that renders it again. PHOTONFARM_DEVICE says what renders. Exit
code 0 if everything passes, 1 if a row or an invariance fails, 2 for an unknown one.
"""

from __future__ import annotations

import argparse
import gc
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.stability.invariances import Invariance
    from tests.stability.scenes.case import BdptSettings


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.stability", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", action="extend", default=[], help="rows (1 … 36) or scenes")
    parser.add_argument("--settings", nargs="+", default=[], help="connections,light_ratio[,guided]")
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--quick", action="store_true", help="as in the tests: small images, mostly one settings")
    parser.add_argument("--threads", type=int, default=1, help="threads of Dr.Jit")
    parser.add_argument("--out", type=Path, default=Path("stability"), help="folder of stability.md, .json and .png")
    parser.add_argument("--invariances", nargs="*", help="these alone (names or how they begin), or all of them")
    options = parser.parse_args(arguments)

    from photonfarm.renderer.scene import backend

    backend.load(options.threads)
    from tests.stability import invariances, report, rows

    try:
        checks = invariances.choose(options.invariances or [], long=not options.quick)
        settings = [parse_settings(text) for text in options.settings]
        scenes = rows.choose(options.only, quick=options.quick, settings=settings)
    except ValueError as error:
        parser.error(str(error))
    if options.invariances is not None:
        return 0 if hold(checks) else 1
    options.out.mkdir(parents=True, exist_ok=True)  # now: what cannot be written should not be rendered first
    found = report.examine(
        scenes,
        quick=options.quick,
        seed=options.seed,
        settings=settings,
        failures=options.out / "failures",
        log=lambda line: print(line, file=sys.stderr, flush=True),
    )
    command = shlex.join(["python", "-m", "tests.stability", *arguments])
    report.write(found, options.out, command)
    print(report.markdown(found, command))
    held = bool(options.only or settings) or hold(checks)
    return 0 if held and found.passed else 1


def parse_settings(text: str) -> BdptSettings:
    """Settings from "connections,light_ratio" or "connections,light_ratio,guided"; raises ValueError for others."""
    from tests.stability.scenes.case import BdptSettings

    connections, light_ratio, *guided = text.split(",")
    if guided not in ([], ["guided"]):
        raise ValueError(f"settings are {text!r}; allowed is connections,light_ratio[,guided]")
    return BdptSettings(int(connections), float(light_ratio), bool(guided))


def hold(checks: Sequence[Invariance]) -> bool:
    """Run the checks and print what each found; whether all of them hold."""
    failed = 0
    for check in checks:
        faults, figures = check.run()
        failed += bool(faults)
        verdict = f"FAIL: {'; '.join(faults)}. Again: {check.command}" if faults else "pass"
        print(f"- {check.name}, {check.claim}: {figures}: {verdict}", flush=True)
        gc.collect()
    print(f"**{len(checks) - failed} of {len(checks)} invariances hold.**")
    return not failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
