"""What a sample of `bdpt` costs against one of `path` and one of `ptracer`.

    python -m bench.renderer.cost [--scene cornell] [--size 256] [--spp 16] [--repetitions 9] [--out DIR]

Each repetition renders one image of every method, in turn; the cost is the median over repetitions of the ratio of CPU
times within one. A render call counts whole, with the tracing in Python, the launch and the download, but for the first
of each method, which compiles. Exit code 0.
"""

from __future__ import annotations

import statistics
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

from bench.harness import results

MAX_DEPTH, RR_DEPTH = 8, 5
METHODS: dict[str, dict[str, Any]] = {
    "path": {"type": "path"},
    "ptracer": {"type": "ptracer"},
    **{
        f"bdpt ({connections}, {ratio:g})": {
            "type": "bdpt",
            "connections": connections,
            "light_ratio": ratio,
            "record": True,
        }
        for connections, ratio in ((0, 0.0), (0, 0.25), (0, 1.0), (1, 1.0), (2, 0.25), (4, 0.125), (8, 0.125))
    },
}


@dataclass(frozen=True, slots=True)
class MethodCost:
    """One method; times are CPU seconds of a render call."""

    method: str
    first_s: float  # with the compilation
    median_s: float
    cost: float  # over `path`, median of the ratios within a repetition
    cost_from: float
    cost_to: float


def measure(scene: Any, spp: int, repetitions: int) -> list[MethodCost]:
    """Every method on one scene, in turn."""
    import mitsuba as mi

    settings = {"max_depth": MAX_DEPTH, "rr_depth": RR_DEPTH}
    integrators = {name: mi.load_dict({**method, **settings}) for name, method in METHODS.items()}

    def seconds(name: str, seed: int) -> float:
        start = time.process_time()
        integrators[name].render(scene, sensor=0, seed=seed, spp=spp).numpy()
        return time.process_time() - start

    first = {name: seconds(name, 0) for name in METHODS}
    turns = [{name: seconds(name, seed) for name in METHODS} for seed in range(1, repetitions + 1)]
    rows = []
    for name in METHODS:
        ratios = [turn[name] / turn["path"] for turn in turns]
        middle = statistics.median(turn[name] for turn in turns)
        rows.append(MethodCost(name, first[name], middle, statistics.median(ratios), min(ratios), max(ratios)))
    return rows


def page(scene: str, size: int, spp: int, repetitions: int, rows: list[MethodCost]) -> str:
    """The table as Markdown."""
    header = ("method", "CPU ms an image", "cost of a sample over `path`", "least … greatest", "first call, CPU s")
    lines = [
        (
            f"`{row.method}`",
            f"{row.median_s * 1e3:.0f}",
            f"×{row.cost:.2f}",
            f"{row.cost_from:.2f} … {row.cost_to:.2f}",
            f"{row.first_s:.2f}",
        )
        for row in rows
    ]
    return f"""# Cost of a sample

`{scene}` at {size}², {spp} spp, max_depth {MAX_DEPTH}, one thread; medians of {repetitions} images of each method,
rendered in turn. `bdpt` (connections, light paths per eye path), with recorded launches as the workers have them. What
a sample buys for its cost is in [bdpt_against_peers.md](bdpt_against_peers.md).

{results.table(header, lines)}"""


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = results.parser(__doc__)
    parser.add_argument("--scene", default="cornell", help="one of the hard scenes (cornell)")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repetitions", type=int, default=9)
    options = parser.parse_args()

    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    import mitsuba as mi

    from tests.stability.scenes.hard_scenes import HARD_SCENES

    if options.scene not in HARD_SCENES:
        parser.error(f"--scene {options.scene}: is none of {', '.join(sorted(HARD_SCENES))}")
    rows = measure(
        mi.load_dict(HARD_SCENES[options.scene](options.size), optimize=False), options.spp, options.repetitions
    )
    values = {
        "scene": options.scene,
        "size": options.size,
        "spp": options.spp,
        "rows": [asdict(row) for row in rows],
    }
    text = page(options.scene, options.size, options.spp, options.repetitions, rows)
    results.write("cost", text, values, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
