#!/usr/bin/env python3
"""Compares the integrator `bdpt` with Mitsuba's `path`: is it unbiased, and what does it cost.

    python bench/compare_with_path.py [--scene cornell glass_caustic kitchen] [--json OUT] [--pictures DIR]

A scene is a name of `photonfarm.renderer.bdpt.hard_scenes`, a folder under $PHOTONFARM_SCENES, or a path of a Mitsuba
XML file. Per scene, independent renders of either integrator are compared: block z-test (16×16 blocks), ratio of the
means, relMSE·time, cost per sample. Verdict: |z| < 4.5 in every block, and means within 0.5 % (or within 3 standard
errors where these are wider, marked «noisy»). Exit code 0 if every scene passes, 1 otherwise, 2 for an unknown scene.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scene_loading import load

Z_LIMIT = 4.5
MEAN_LIMIT = 0.005
BLOCKS = 16


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
class Row:
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
    efficiency: (
        float  # (relMSE·time) of path over that of bdpt, above 1: bdpt is better; first renders (compiling) left out
    )
    efficiency_trimmed: float  # the same without the worst 1 % of the pixels
    cost_per_sample: float  # time of a bdpt sample over that of a path sample
    path_wall_s: float
    bdpt_wall_s: float
    verdict: str


def render(scene: Any, integrator: dict[str, Any], seeds: range, spp: int) -> tuple[Any, float]:
    """([K, H, W, 3] images of these seeds, seconds per image).

    The first image is rendered once more beforehand, to compile.
    """
    import mitsuba as mi

    plugin = mi.load_dict(integrator)
    np.array(mi.render(scene, integrator=plugin, spp=min(spp, 4), seed=seeds[0]))
    images, start = [], time.perf_counter()
    for seed in seeds:
        images.append(np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed))[..., :3])  # noqa: PERF401
    return np.stack(images), (time.perf_counter() - start) / len(seeds)


def compare(name: str, plan: Plan, arguments: argparse.Namespace) -> tuple[Row, dict[str, Any]]:
    """(line of the table, pictures) of one scene."""
    from photonfarm.shared.statistics import block_z_test, relative_mse

    scene = load(name, plan.size)
    common = {"max_depth": plan.max_depth, "rr_depth": 5}
    bdpt = {"type": "bdpt", "connections": arguments.connections, "light_ratio": arguments.light_ratio, **common}
    a, bdpt_s = render(scene, bdpt, range(1, 1 + plan.seeds), plan.bdpt_spp)
    b, path_s = render(scene, {"type": "path", **common}, range(10_001, 10_001 + plan.seeds), plan.path_spp)
    test = block_z_test(a, b, blocks=BLOCKS)
    reference = weighted_mean(a, b)
    cost = bdpt_s / plan.bdpt_spp / (path_s / plan.path_spp)

    def error(images: Any, trim: float) -> float:
        """relMSE about the set's own mean: that of another would count the better set's images against themselves."""
        centred = images - images.mean(axis=0) + reference
        return relative_mse(centred, reference, trim=trim) * len(images) / (len(images) - 1)

    efficiency, trimmed = (error(b, trim) * path_s / (error(a, trim) * bdpt_s) for trim in (0.0, 0.01))
    row = Row(
        name, plan.size, plan.seeds, plan.path_spp, plan.bdpt_spp, arguments.connections, arguments.light_ratio,
        plan.max_depth, test.z_max, test.mean_ratio, test.mean_ratio_standard_error, efficiency, trimmed, cost,
        path_s * plan.seeds, bdpt_s * plan.seeds, verdict(test),
    )  # fmt: skip
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


def weighted_mean(a: Any, b: Any) -> Any:
    """Mean image of both sets, each weighted by the inverse variance of its mean: the best reference there is."""
    precision_a, precision_b = (1 / max(float(x.var(axis=0, ddof=1).mean()) / len(x), 1e-30) for x in (a, b))
    return (a.mean(axis=0) * precision_a + b.mean(axis=0) * precision_b) / (precision_a + precision_b)


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


def print_table(rows: list[Row]) -> None:
    """The table as Markdown."""
    print(
        "| scene | size | seeds | spp path / bdpt | max block z | mean ratio | efficiency | trimmed | cost | wall s |",
        end="",
    )
    print(" verdict |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for r in rows:
        ratio = f"{r.mean_ratio:.4f} ± {r.mean_ratio_standard_error:.4f}"
        print(
            f"| {r.scene} | {r.size}² | {r.seeds} | {r.path_spp} / {r.bdpt_spp} | {r.z_max:.2f} "
            f"| {ratio} | {r.efficiency:.2f} | {r.efficiency_trimmed:.2f} "
            f"| ×{r.cost_per_sample:.2f} | {r.path_wall_s + r.bdpt_wall_s:.0f} | {r.verdict} |"
        )


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
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
    parser.add_argument("--json", type=Path, help="write the table here")
    parser.add_argument("--pictures", type=Path, help="write mean images and block z-scores into this folder")
    return parser.parse_args()


def main() -> int:
    arguments = parse()
    from photonfarm.renderer import backend

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
            print(f"compare_with_path: {error}", file=sys.stderr)
            return 2
        rows.append(row)
        print(f"{name}: {row.verdict}", file=sys.stderr)
        if arguments.pictures:
            save_pictures(arguments.pictures, name, pictures)
        if arguments.json:
            arguments.json.write_text(json.dumps([asdict(r) for r in rows], indent=1) + "\n")
        del pictures
        gc.collect()  # the next scene's kernels are found in the cache only once this scene is gone
    print_table(rows)
    return 0 if all(row.verdict.startswith("pass") for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
