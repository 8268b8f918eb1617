#!/usr/bin/env python3
"""Runs experiments from nothing to their reports, and goes on where it was interrupted.

    python experiments/run.py [NAME ...] [--size small] [--minutes N] [--workers 2] [--work build/experiments]
                              [--networks NETWORK ...] [--dry-run]

Each is a file NAME.toml beside this one; without names all are run, in the order of their names. What is rendered
and trained stays in WORK/SIZE/NAME; the report lies in its folder report/. With `--minutes` what is at work then is
stopped, and the same command goes on later; what would begin anew, as a report does, comes to its end first. In each
room the most telling networks come first. With `--networks` these alone are trained, from the first seed, and reported:
a look, of which tables.py makes no page. `--dry-run` says what that would take: what a sample costs is measured on this
machine, training is counted in operations. Exit code 0, 2 for wrong usage, 3 for a name that no experiment has or a
file that is wrong, 7 where an experiment did not come to its end: the others are run all the same.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import get_args

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script this finds its own folder alone

from bench.harness.results import ROOT
from experiments import dry_run
from experiments.experiment import Experiment, SizeName, list_names
from experiments.stages import Stages, tell
from photonfarm.core.errors import IncompleteError, PhotonfarmError, SpecError


def make_parser() -> argparse.ArgumentParser:
    """The options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="experiments (all)")
    parser.add_argument("--size", choices=get_args(SizeName), default="small")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after so long (never)")
    parser.add_argument("--networks", nargs="+", default=(), metavar="NETWORK", help="(all)")
    parser.add_argument("--workers", type=_parse_count, default=2, help="processes at a time, a core each (2)")
    parser.add_argument("--work", type=Path, default=ROOT / "build/experiments", help="(build/experiments)")
    parser.add_argument("--dry-run", action="store_true", help="say what it would take, and do none of it")
    return parser


def _parse_count(text: str) -> int:
    """A whole number of at least 1; raises ArgumentTypeError."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of processes; at least 1 is needed")
    return int(text)


def main() -> int:
    """Run them; returns the exit code."""
    arguments = make_parser().parse_args()
    try:
        experiments = [Experiment.load(name, arguments.size) for name in arguments.names or list_names()]
        if arguments.networks:
            experiments = [experiment.only(arguments.networks) for experiment in experiments]
        for experiment in experiments:
            experiment.spec()  # what is wrong should be said before hours go by
    except SpecError as error:
        tell(f"error: {error}")
        return SpecError.exit_code
    if arguments.dry_run:
        for experiment in experiments:
            print(dry_run.measure_need(experiment).describe(), flush=True)
        return 0
    failed, until = False, time.monotonic() + 60 * arguments.minutes
    for experiment in experiments:
        stages = Stages(experiment, arguments.work / arguments.size / experiment.name, arguments.workers, until)
        try:
            tell(f"{experiment.name}: {stages.run()}")
        except PhotonfarmError as error:
            failed = True
            tell(f"error: {error}")
    return IncompleteError.exit_code if failed else 0


if __name__ == "__main__":
    sys.exit(main())
