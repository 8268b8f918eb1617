"""Whether kernels are faster with gather instructions, on a processor for which LLVM avoids them (`native/gathers`).

    python -m bench.renderer.gathers [--scene cornell room ...] [--size 128] [--spp 8] [--repetitions 9] [--out DIR]

Images with and without the instruction are rendered in turn, with equal seeds, on one thread; what counts is the time
in which kernels ran. Where LLVM uses gather instructions anyway, as it does with AVX-512, both are alike. Exit code 0;
1 where the images differ; 2 for an unknown scene, or where Dr.Jit does not tell which processor it compiles for.
"""

from __future__ import annotations

import argparse
import gc
import statistics
import sys
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.harness import results
from bench.renderer import scene_loading
from bench.renderer.rays import seconds
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.native import gathers

SCENES = ("cornell", "room", "kitchen", "veach-ajar", "cove")
METHODS: dict[str, dict[str, Any]] = {
    "path": {"type": "path"},
    "bdpt (0, 0)": {"type": "bdpt", "connections": 0, "light_ratio": 0.0},
    "bdpt (1, 1)": {"type": "bdpt", "connections": 1, "light_ratio": 1.0},
    "bdpt (4, 0.125)": {"type": "bdpt", "connections": 4, "light_ratio": 0.125},
}
MAX_DEPTH = 8


@dataclass(frozen=True, slots=True)
class GatherTimes:
    """One method in one scene: seconds in which kernels ran, medians."""

    scene: str
    method: str
    without_s: float
    with_s: float
    ratio: float  # with over without, median of the ratios of equal seeds
    ratio_from: float  # quartiles
    ratio_to: float
    same: bool  # whether all images are, bit by bit


def measure(name: str, options: argparse.Namespace, usual: str) -> list[GatherTimes]:
    """All methods in one scene; `usual` are LLVM's own features of the processor."""
    import mitsuba as mi

    scene = scene_loading.load(name, options.size)
    rows = []
    for method, properties in METHODS.items():
        integrator = mi.load_dict({**properties, "max_depth": MAX_DEPTH})
        times, same = [], True
        for seed in range(options.repetitions + 1):
            without, without_s = rendered(integrator, scene, seed, options.spp, usual)
            having, having_s = rendered(integrator, scene, seed, options.spp, f"{usual},{gathers.FEATURE}")
            times.append((without_s, having_s))
            same &= np.array_equal(without, having)
        del times[0]  # it may have compiled
        low, middle, high = statistics.quantiles([after / before for before, after in times], n=4)
        before_s, after_s = (statistics.median(part) for part in zip(*times, strict=True))
        rows.append(GatherTimes(name, method, before_s, after_s, middle, low, high, same))
    return rows


def rendered(integrator: Any, scene: Any, seed: int, spp: int, features: str) -> tuple[NDArray[np.float32], float]:
    """(image, seconds in which kernels ran), with kernels that are compiled for these features."""
    gathers.set_features(features)
    images: list[NDArray[np.float32]] = []
    _, kernels_s = seconds(lambda: images.append(np.array(integrator.render(scene, seed=seed, spp=spp))))
    return images[0], kernels_s


def page(rows: list[GatherTimes], options: argparse.Namespace, cpu: str) -> str:
    header = ["scene", "method", "without, ms", "with, ms", "with ÷ without", "its quartiles", "same bits"]
    lines = [
        [
            row.scene,
            f"`{row.method}`",
            f"{1e3 * row.without_s:.0f}",
            f"{1e3 * row.with_s:.0f}",
            f"{row.ratio:.2f}",
            f"{row.ratio_from:.2f} to {row.ratio_to:.2f}",
            "yes" if row.same else "no",
        ]
        for row in rows
    ]
    return f"""# Gather instructions

Time in which kernels ran, of images of {options.size}² pixels and {options.spp} spp on one thread, with and without
gather instructions, which load a vector from scattered addresses at once, on a processor that LLVM calls `{cpu}`
(`znver3` is AMD's Zen 3). `bdpt` is given with its connections and light ratio. Images of equal seeds are rendered in
turn. All columns are medians of {options.repetitions}: with ÷ without is that of the ratios of equal seeds, not the
ratio of the two columns before it. Below 1 the instructions are faster. "Without" is LLVM's own choice. The farm uses
the instructions on the processors in `FASTER_ON` of `services/renderer/photonfarm/renderer/scene/native/gathers.py`.

{results.table(header, lines)}

Geometric mean of with ÷ without: **{statistics.geometric_mean(row.ratio for row in rows):.2f}**."""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--scene", nargs="+", default=list(SCENES))
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--repetitions", type=int, default=9)
    options = parser.parse_args()
    backend.load(threads=1)
    cpu, features = gathers.target()
    if not cpu:
        print("gathers: Dr.Jit does not tell which processor it compiles for", file=sys.stderr)
        return 2
    usual = ",".join(feature for feature in features.split(",") if feature != gathers.FEATURE)
    rows = []
    for name in options.scene:
        try:
            rows += measure(name, options, usual)
        except ValueError as error:
            print(f"gathers: {error}", file=sys.stderr)
            return 2
        gc.collect()
    results.write("gathers", page(rows, options, cpu), {"rows": [asdict(row) for row in rows]}, options.out)
    return 0 if all(row.same for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
