"""Renders the 36 rows of hard scenes with `bdpt` and compares each with its truth; prints the table.

    python -m bench.renderer.stability [--only 13 25-hundred-lights] [--settings 1,1 0,0] [--seed 0] [--quick]
        [--threads 1] [--json OUT] [--out DIR] [--invariances [counts additive-many-lights …]]

Without --quick this is the long version. After all scenes (no --only, no --settings), or alone with --invariances, it
checks what must not change an image: technique counts, sums of lights, units, edits in place, seeds. A failure keeps
its renders under .stability/ (or DIR/failures) and prints the command that renders it again. Exit code 0 if everything
passes, 1 if a row or an invariance fails, 2 for an unknown one.
"""

from __future__ import annotations

import argparse
import gc
import shlex
import sys
from pathlib import Path
from typing import Any


def settings(text: str) -> Any:
    from photonfarm.renderer.verify.scenes.case import BdptSettings

    connections, light_ratio, *guided = text.split(",")
    if guided not in ([], ["guided"]):
        raise ValueError(text)
    return BdptSettings(int(connections), float(light_ratio), bool(guided))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], help="rows (1 … 36) or scenes")
    parser.add_argument("--settings", nargs="+", type=settings, default=[], help="connections,light_ratio[,guided]")
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--quick", action="store_true", help="as in the tests")
    parser.add_argument("--threads", type=int, default=1, help="threads of Dr.Jit")
    parser.add_argument("--json", type=Path, help="write all results here")
    parser.add_argument("--out", type=Path, help="write stability.md, .json and .png into this folder")
    parser.add_argument("--invariances", nargs="*", help="these alone (names or how they begin), or all of them")
    options = parser.parse_args()

    from photonfarm.renderer.scene import backend

    backend.load(options.threads)
    from bench.renderer import invariances
    from photonfarm.renderer.verify import report, rows

    try:
        checks = invariances.chosen(options.invariances or [], long=not options.quick)
        scenes = rows.chosen(options.only, quick=options.quick, settings=options.settings)
    except ValueError as error:
        parser.error(str(error))
    if options.invariances is not None:
        return 0 if hold(checks) else 1
    found = report.examine(
        scenes,
        quick=options.quick,
        seed=options.seed,
        settings=options.settings,
        failures=options.out / "failures" if options.out else report.FAILURES,
        log=lambda line: print(line, file=sys.stderr, flush=True),
    )
    command = shlex.join(["python", "-m", "bench.renderer.stability", *sys.argv[1:]])
    if options.json:
        options.json.write_text(report.as_json(found, command), encoding="utf-8")
    if options.out:
        report.write(found, options.out, command)
    print(report.markdown(found, command))
    held = hold(checks) if not (options.only or options.settings) else True
    return 0 if held and found.passed else 1


def hold(checks: Any) -> bool:
    """Run the checks, print their table; whether all of them hold."""
    from bench.renderer import invariances

    found = []
    for check in checks:
        found.append((check, check.run()))
        print(f"{check.name}: {'; '.join(found[-1][1].faults) or 'pass'}", file=sys.stderr, flush=True)
        gc.collect()
    print(invariances.markdown(found))
    return not any(finding.faults for _, finding in found)


if __name__ == "__main__":
    sys.exit(main())
