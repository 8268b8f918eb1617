"""Compares the integrator `bdpt` with Mitsuba's `path`: whether it is unbiased.

    python -m bench.renderer.compare_with_path [--scene cornell glass_caustic kitchen] [--out DIR] [--pictures DIR]

A scene is a name of `tests.stability.scenes.hard_scenes`, a folder under $PHOTONFARM_SCENES, or a path of a
Mitsuba XML file. Per scene, independent renders of either integrator are compared: block z-test (16×16 blocks), ratio
of the means. Verdict: |z| < 4.5 in every block, and means within 0.5 % (or within 3 standard errors where these are
wider, marked «noisy»). Exit code 0 if every scene passes, 1 otherwise, 2 if a scene is unknown
(the others are compared all the same).
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness import results
from bench.renderer.scene_loading import load

Z_LIMIT = 4.5
MEAN_LIMIT = 0.005
BLOCKS = 16

EXPLANATION = """\
# `bdpt` against Mitsuba's `path`

    make bench-compare-with-path     # PHOTONFARM_SCENES names the folder with kitchen/ and veach-ajar/

Is `bdpt` unbiased: independent renders of both integrators (connections {connections}, light ratio {light_ratio:g}),
{blocks} × {blocks} blocks. What it gains stands in [bdpt_against_peers.md](bdpt_against_peers.md).

- **Max block z**: largest |difference of block means| in standard errors, mapped to a normal distribution; the limit is
  {z:g}.
- **Mean ratio**: `bdpt` over `path`, ± one standard error; within {mean:.1%}, or within 3 standard errors where these
  are wider (“noisy”).
- **Wall s**: of all renders of both.
"""
CAUSTIC = """\
The glass caustic needs many samples of both before its block means are normally distributed: at 256 samples per
pixel light that crosses the ball twice is still too rare, and blocks behind the ball fail the test against a converged
`path` (z up to 7.8 with 64 seeds, mean ratio 1.0000 ± 0.0014). At 8192 they pass."""


@dataclass(frozen=True, slots=True)
class Plan:
    """How much work a scene gets: chosen so that each ends within about five minutes on two cores."""

    size: int  # pixels, square
    path_spp: int
    bdpt_spp: int
    max_depth: int
    seeds: int = 8  # independent renders of each integrator


PLANS = {
    "cornell": Plan(64, 1024, 256, 8),
    # light that comes out of the ball twice is found by chance alone, by either: blocks are normal after many samples
    "glass_caustic": Plan(48, 32768, 8192, 8, seeds=16),
    "cove": Plan(48, 2048, 256, 8),
    "room": Plan(64, 1024, 256, 8),
    "kitchen": Plan(64, 1024, 192, 8),
    "veach-ajar": Plan(64, 512, 96, 8),
}
DEFAULT_PLAN = Plan(64, 1024, 256, 8)


@dataclass(frozen=True, slots=True)
class PathComparison:
    """One line of the table."""

    scene: str
    size: int
    seeds: int
    path_spp: int
    bdpt_spp: int
    connections: int
    light_ratio: float
    max_depth: int
    z_max: float
    mean_ratio: float
    mean_ratio_standard_error: float
    wall_s: float  # of all renders of both, with compilation
    verdict: str


def render(scene: Any, integrator: dict[str, Any], seeds: range, spp: int) -> Any:
    """The images of these seeds, [K, H, W, 3] linear radiance."""
    import mitsuba as mi

    plugin = mi.load_dict(integrator)
    images = (np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed)) for seed in seeds)
    return np.stack([image[..., :3] for image in images])


def compare(name: str, plan: Plan, arguments: argparse.Namespace) -> tuple[PathComparison, dict[str, Any]]:
    """(line of the table, pictures) of one scene."""
    from photonfarm.core.statistics import block_z_test

    scene = load(name, plan.size)
    common = {"max_depth": plan.max_depth, "rr_depth": 5}
    bdpt = {"type": "bdpt", "connections": arguments.connections, "light_ratio": arguments.light_ratio, **common}
    start = time.perf_counter()
    a = render(scene, bdpt, range(1, 1 + plan.seeds), plan.bdpt_spp)
    b = render(scene, {"type": "path", **common}, range(10_001, 10_001 + plan.seeds), plan.path_spp)
    wall_s = time.perf_counter() - start
    test = block_z_test(a, b, blocks=BLOCKS)
    row = PathComparison(
        name,
        plan.size,
        plan.seeds,
        plan.path_spp,
        plan.bdpt_spp,
        arguments.connections,
        arguments.light_ratio,
        plan.max_depth,
        test.z_max,
        test.mean_ratio,
        test.mean_ratio_standard_error,
        wall_s,
        verdict(test),
    )
    return row, {"bdpt": a.mean(axis=0), "path": b.mean(axis=0), "z": test.z}


def verdict(test: Any) -> str:
    """'pass', 'pass, noisy' where the standard error of the mean does not resolve the limit, or what failed."""
    off = abs(test.mean_ratio - 1)
    if not test.finite:
        return "FAIL (not finite)"
    if test.z_max >= Z_LIMIT:
        return "FAIL (block)"
    if off <= MEAN_LIMIT:
        return "pass"
    return "pass, noisy" if off < 3 * test.mean_ratio_standard_error else "FAIL (mean)"


def save_pictures(folder: Path, name: str, pictures: dict[str, Any]) -> None:
    """The mean images (linear float32 [H, W, 3] as .npy, and PNG to look at), and the block z-scores as text."""
    import mitsuba as mi

    folder.mkdir(parents=True, exist_ok=True)
    stem = Path(name).parent.name if name.endswith(".xml") else name
    for kind in ("bdpt", "path"):
        mean = np.ascontiguousarray(pictures[kind], dtype=np.float32)
        np.save(folder / f"{stem}_{kind}.npy", mean)
        # Not EXR: Mitsuba's writer waits forever when Dr.Jit has a single thread
        picture = mi.Bitmap(mean).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
        picture.write(str(folder / f"{stem}_{kind}.png"))
    np.savetxt(folder / f"{stem}_z.txt", pictures["z"], fmt="%6.2f")


def page(rows: list[PathComparison], arguments: argparse.Namespace) -> str:
    """The Markdown page."""
    header = ("scene", "size", "seeds", "spp path / bdpt", "max block z", "mean ratio", "wall s", "verdict")
    lines = (
        (
            r.scene,
            f"{r.size}²",
            r.seeds,
            f"{r.path_spp} / {r.bdpt_spp}",
            f"{r.z_max:.2f}",
            f"{r.mean_ratio:.4f} ± {r.mean_ratio_standard_error:.4f}",
            f"{r.wall_s:.0f}",
            r.verdict,
        )
        for r in rows
    )
    explanation = EXPLANATION.format(
        connections=arguments.connections, light_ratio=arguments.light_ratio, blocks=BLOCKS, z=Z_LIMIT, mean=MEAN_LIMIT
    )
    caustic = f"\n\n{CAUSTIC}" if any(row.scene == "glass_caustic" for row in rows) else ""
    return f"{explanation}\n{results.table(header, lines)}{caustic}"


def parse() -> argparse.Namespace:
    parser = results.parser(__doc__)
    parser.add_argument(
        "--scene", nargs="+", default=list(PLANS), help="names, folders or XML files (default: all planned)"
    )
    parser.add_argument(
        "--seeds", type=int, help="override the planned independent renders of each integrator, at least 2"
    )
    parser.add_argument("--connections", type=int, default=1)
    parser.add_argument("--light-ratio", type=float, default=1.0)
    parser.add_argument("--size", type=int, help="override the planned image size")
    parser.add_argument("--path-spp", type=int, help="override the planned samples per pixel of path")
    parser.add_argument("--bdpt-spp", type=int, help="override the planned samples per pixel of bdpt")
    parser.add_argument("--max-depth", type=int, help="override the planned path length")
    parser.add_argument("--threads", type=int, help="Dr.Jit's threads (default: all cores)")
    parser.add_argument("--pictures", type=Path, help="write mean images and block z-scores into this folder")
    return parser.parse_args()


def main() -> int:
    arguments = parse()
    from photonfarm.renderer.scene import backend

    backend.load(arguments.threads)
    rows = []
    for name in arguments.scene:
        plan = PLANS.get(name, DEFAULT_PLAN)
        plan = Plan(
            arguments.size or plan.size,
            arguments.path_spp or plan.path_spp,
            arguments.bdpt_spp or plan.bdpt_spp,
            arguments.max_depth or plan.max_depth,
            arguments.seeds or plan.seeds,
        )
        try:
            row, pictures = compare(name, plan, arguments)
        except ValueError as error:
            print(f"compare_with_path: {name} is left out: {error}", file=sys.stderr)
            continue
        rows.append(row)
        print(f"{name}: {row.verdict}", file=sys.stderr)
        if arguments.pictures:
            save_pictures(arguments.pictures, name, pictures)
        del pictures
        gc.collect()  # the next scene's kernels are found in the cache only once this scene is gone
    if rows:
        values = {"rows": [asdict(row) for row in rows]}
        results.write("compare_with_path", page(rows, arguments), values, arguments.out, page="bdpt_against_path")
    if len(rows) < len(arguments.scene):
        return 2
    return 0 if all(row.verdict.startswith("pass") for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
