"""Compares `bdpt` with its peers at equal time: Mitsuba's `path` and `ptracer`, and pyluxcore's BIDIRCPU.

`path` is measured with Mitsuba's independent sampler and with its best stratified one.

    python -m bench.renderer.render [--scene cornell cove] [--methods path bdpt] [--seconds 1] [--seeds 8] [--quick]

Each scene's result is kept as JSON in OUT/render/ and not measured again with equal settings and an equal integrator;
the page and the plots are made anew from all that is kept. A run that is cut goes on where it was.
Exit code 0; 2 for bad arguments, and if a scene could not be loaded (the others are measured all the same).
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import json
import os
import platform
import sys
import tempfile
import time
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

from bench.harness import results
from bench.renderer.peers import chosen, page, plot
from bench.renderer.peers.measure import MeasureSettings, measure, say
from bench.renderer.peers.plans import METHODS, PLANS, estimated_seconds
from bench.renderer.scene_loading import load
from photonfarm.core.files import write_whole


def parse() -> argparse.Namespace:
    parser = results.parser(__doc__)
    parser.add_argument("--scene", nargs="+", default=list(PLANS), choices=list(PLANS), metavar="NAME")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS, metavar="METHOD")
    parser.add_argument("--seconds", type=float, default=1.0, help="time budget of an image (default 1)")
    parser.add_argument("--seeds", type=int, default=8, help="images of each method at each budget, at least 3")
    parser.add_argument("--size", type=int, default=128, help="pixels of a side (default 128)")
    parser.add_argument("--threads", type=int, default=1, help="of each method (default 1, as a worker has)")
    parser.add_argument("--clock", choices=["wall", "cpu"], default="cpu", help="what equal time means (default cpu)")
    parser.add_argument("--reference", type=float, default=16, help="time of a reference, in budgets (default 16)")
    parser.add_argument("--pilot-seconds", type=float, default=20, help="CPU time of the pilot of each scene")
    parser.add_argument(
        "--chosen", default="", metavar="C,R[,guided]", help="settings of the method chosen, without a pilot"
    )
    parser.add_argument("--json", type=Path, help="write all results into this file too")
    parser.add_argument("--quick", action="store_true", help="a test run: 64², 0.2 s, 4 seeds, short pilot")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.size, arguments.seconds, arguments.seeds, arguments.pilot_seconds = 64, 0.2, 4, 4.0
    if arguments.seeds < 3 or arguments.seconds <= 0 or arguments.reference <= 0:
        parser.error("--seeds must be at least 3, --seconds and --reference above 0")
    if arguments.chosen:
        try:
            chosen.given(arguments.chosen)
        except ValueError as error:
            parser.error(str(error))
    return arguments


def main() -> int:
    arguments = parse()
    settings = MeasureSettings(
        tuple(arguments.methods),
        arguments.seconds,
        arguments.seeds,
        arguments.size,
        arguments.threads,
        arguments.clock,
        arguments.reference,
        arguments.pilot_seconds,
        arguments.chosen,
    )
    folder = arguments.out / "render"
    folder.mkdir(parents=True, exist_ok=True)
    key = {**asdict(settings), "methods": list(settings.methods), "versions": versions(), "code": code()}
    pending = [name for name in arguments.scene if kept(folder, name, key) is None]
    s, pilot_s = settings, settings.pilot_seconds if "chosen" in settings.methods and not settings.chosen else 0.0
    seconds = estimated_seconds(len(pending), len(s.methods), s.seeds, s.seconds, s.reference, pilot_s)
    say(f"{len(pending)} of {len(arguments.scene)} scenes to measure: about {seconds / 60:.0f} minutes")
    try:
        left_out = run(pending, settings, folder, key)
    finally:
        write(arguments, folder, key)
    for name, reason in left_out.items():
        print(f"render: {name} is left out: {reason}", file=sys.stderr)
    return 2 if left_out else 0


def run(pending: list[str], settings: MeasureSettings, folder: Path, key: dict[str, Any]) -> dict[str, str]:
    """Measure what is not yet there. Returns why scenes were left out that cannot be loaded."""
    left_out: dict[str, str] = {}
    if not pending:
        return left_out
    commit = results.commit()  # before measuring: others may commit meanwhile
    with tempfile.TemporaryDirectory(prefix="kernels-", ignore_cleanup_errors=True) as cache:
        os.environ["DRJIT_CACHE_DIR"] = cache  # an empty cache: compile times are those of a first use
        from photonfarm.renderer.scene import backend

        backend.load(settings.threads)
        for name in pending:
            say(f"{name}:")
            start = time.perf_counter()
            try:
                scene = load(PLANS[name].scene, settings.size)
            except ValueError as error:
                left_out[name] = str(error)
                continue
            result = measure(name, PLANS[name], settings, scene)
            result |= {"settings": key, "machine": machine(), "commit": commit, "took_s": time.perf_counter() - start}
            write_whole(folder / f"{name}.json", json.dumps(result, indent=1) + "\n")
            say(f"  took {result['took_s']:.0f} s")
            del scene
            gc.collect()
    return left_out


def kept(folder: Path, name: str, key: dict[str, Any]) -> dict[str, Any] | None:
    """The result of a scene that was measured with equal settings, if there is one."""
    try:
        result: dict[str, Any] = json.loads((folder / f"{name}.json").read_text())
    except (OSError, ValueError):
        return None
    return result if result.get("settings") == key else None


def write(arguments: argparse.Namespace, folder: Path, key: dict[str, Any]) -> None:
    """The page, the plots and the JSON, from all results that are there with equal settings."""
    found = [result for name in PLANS if (result := kept(folder, name, key)) is not None]
    if not found:
        return
    for result in found:
        plot.save(result, folder / f"{result['line']}.png", arguments.clock)
    text = page.page(found, key, found[0]["machine"])
    (arguments.out / "bdpt_against_peers.md").write_text(text)
    print(text)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


def versions() -> dict[str, str]:
    """Versions of what renders; what is not installed is left out."""
    found = {}
    for name in ("mitsuba", "drjit", "pyluxcore"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def code() -> str:
    """Digest of the integrator, its strategy, and what loads scenes: a result of other code does not count."""
    package = results.ROOT / "services/renderer/photonfarm/renderer"
    digest = hashlib.sha256()
    for part in ("bdpt", "strategy", "scene"):
        for path in sorted((package / part).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def machine() -> str:
    """The processor, as far as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    return f"{model}, {os.cpu_count()} cores"


if __name__ == "__main__":
    sys.exit(main())
