"""What this machine's device gives and takes, most telling first, within some minutes.

    python -m bench.card [--minutes 8] [--size 256] [--out DIR] [--only PART ...] [--make-references]

Made for a machine with a card and without LLVM; where no card is, the processor is measured. Parts are processes of
their own, each with a quarter of the time at most; if one fails, the page says so, and the others go on. What a part
found is written into OUT/parts as it ends and kept: run again with equal settings and at the same commit, this measures
what is missing. The page is OUT/card.md. Exit code 0; 2 for bad arguments.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.card import equal_time, networks, optix, rates, sample, trained, values, worker
from bench.card.rooms import ROOMS
from bench.harness import results
from bench.trainer.train_step import shown
from photonfarm.core.errors import SpecError
from photonfarm.core.files import write_whole
from photonfarm.core.processes import tie

KINDS: dict[str, Any] = {
    kind.__name__.rpartition(".")[2]: kind
    for kind in (values, sample, rates, worker, networks, equal_time, trained, optix)
}
LEAST_S = 5.0
"""The least time with which a part is begun."""


OF_TIMES = """Milliseconds and rates are by the clock of a card; where a processor renders they are of its time, of all
cores together, however much else is at work. First calls compile what no earlier run left in Dr.Jit's cache."""


@dataclass(frozen=True, slots=True)
class Part:
    """One measurement of a kind: of a room, or of an architecture."""

    kind: str
    of: str

    @property
    def name(self) -> str:
        """What it is called by `--only` and in OUT/parts."""
        return f"{self.kind}-{self.of}"


def list_parts() -> list[Part]:
    """All parts, most telling first."""
    of: list[tuple[str, Sequence[str]]] = [
        ("values", values.SCENES),
        ("sample", ROOMS[:2]),
        ("rates", ROOMS[:1]),
        ("worker", ROOMS[:1]),
        ("networks", list(shown())),
        ("equal_time", ROOMS),
        ("trained", [f"{room}-{network}" for network in trained.NETWORKS for room in ROOMS]),
        ("optix", ROOMS[:1]),
    ]
    return [Part(kind, each) for kind, all_ in of for each in all_]


def describe_run(size: int) -> dict[str, Any]:
    """What a kept result must have been measured with."""
    from photonfarm.renderer.scene import backend

    return {"size": size, "device": backend.device().name, "commit": results.commit()}


def measure(part: Part, run: dict[str, Any], out: Path, limit_s: float) -> None:
    """Measure a part in this process, and write what it found, or why it cannot be found here."""
    began = time.monotonic()
    try:
        found = KINDS[part.kind].measure(part.of, run["size"], out, limit_s)
    except SpecError as error:
        found = {"missing": f"skipped: {error}"}
    write_whole(file_of(part, out), json.dumps({"run": run, "took_s": time.monotonic() - began, **found}) + "\n")


def file_of(part: Part, out: Path) -> Path:
    """Where a part's result is kept."""
    return out / "parts" / f"{part.name}.json"


def read_kept(part: Part, run: dict[str, Any], out: Path) -> dict[str, Any]:
    """What a part found in such a run, or `missing`: why it found nothing."""
    file = file_of(part, out)
    document: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {}
    return document if document.get("run") == run else {"missing": "not begun; the time was over"}


def measure_missing(parts: Sequence[Part], run: dict[str, Any], out: Path, minutes: float) -> None:
    """Measure those parts that found nothing yet, each in a process of its own, while there is time.

    What was skipped is tried again, as packages and scenes may have come.
    """
    end = time.monotonic() + 60 * minutes
    for number, part in enumerate(parts, 1):
        if "missing" not in read_kept(part, run, out):
            continue
        limit = min(60 * minutes / 4, end - time.monotonic())
        if limit < LEAST_S:
            break
        print(f"{number} of {len(parts)}: {part.name}", file=sys.stderr, flush=True)
        if failed := measure_apart(part, run, out, limit):
            write_whole(file_of(part, out), json.dumps({"run": run, "missing": f"failed: {failed}"}) + "\n")
            print(f"  {failed}", file=sys.stderr, flush=True)


def measure_apart(part: Part, run: dict[str, Any], out: Path, limit_s: float) -> str:
    """Measure a part in another process, within a time; returns how it failed, or nothing."""
    told = ["--part", part.name, "--limit-s", str(limit_s), "--size", str(run["size"]), "--out", str(out)]
    command = [sys.executable, "-m", "bench.card", *told]
    log = out / "parts" / f"{part.name}.log"
    with log.open("w") as said:
        try:
            done = subprocess.run(
                tie(command), cwd=results.ROOT, stdin=subprocess.DEVNULL, stdout=said, stderr=said, timeout=limit_s
            )
        except subprocess.TimeoutExpired:
            return f"took longer than {limit_s:.0f} s"
    if not done.returncode:
        return ""
    last = (log.read_text(errors="replace").strip() or "nothing").splitlines()[-1]
    return f"ended with {done.returncode}, and said: {last}"


def page(parts: Sequence[Part], run: dict[str, Any], out: Path) -> str:
    """What was found, by kind, and what is missing."""
    kept = {part: read_kept(part, run, out) for part in parts}
    text = [f"# The device {run['device']}", OF_TIMES]
    for kind, module in KINDS.items():
        found = {part.of: kept[part] for part in parts if part.kind == kind}
        whole = {of: each for of, each in found.items() if "missing" not in each}
        notes = "\n".join(f"- {of}: {each['missing']}" for of, each in found.items() if of not in whole)
        if found:
            text += [f"## {module.TITLE}", *([module.describe(whole)] if whole else []), *([notes] if notes else [])]
    machine = ", ".join(f"{key} {value}" for key, value in results.machine().items())
    text.append(f"Made by `python -m bench.card --size {run['size']}` at commit {run['commit']} ({machine}).")
    return "\n\n".join(text)


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parts = {part.name: part for part in list_parts()}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=8.0, help="of the whole (8)")
    parser.add_argument("--size", type=int, default=256, help="pixels of a side (256)")
    parser.add_argument("--out", type=Path, default=results.ROOT / "build/bench-card", help="(build/bench-card)")
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts), metavar="PART", help="not all parts")
    parser.add_argument("--make-references", action="store_true", help="write the values that others are held against")
    parser.add_argument("--part", choices=parts, help=argparse.SUPPRESS)
    parser.add_argument("--limit-s", type=float, default=120.0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.make_references:
        os.environ["PHOTONFARM_DEVICE"] = "cpu"
        values.write_references()
        return 0
    out = options.out.resolve()
    (out / "parts").mkdir(parents=True, exist_ok=True)
    run = describe_run(options.size)
    if options.part:
        measure(parts[options.part], run, out, options.limit_s)
        return 0
    chosen = [parts[name] for name in parts if name in options.only]
    measure_missing(chosen, run, out, options.minutes)
    results.save("card", page(chosen, run, out), {part.name: read_kept(part, run, out) for part in chosen}, out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
