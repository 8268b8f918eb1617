"""N processes of one thread each against one process of N threads, on the same samples.

    python -m bench.farm.workers [--spec room] [--size 256] [--samples 12] [--processes 2] [--repetitions 5] [--out DIR]

Samples are what a worker makes of a modification: edit, buffers, photons, two half-estimates. Both sides are kept
ready, warmed up, and given the same samples by turns; the time is that until the last process is done. Exit code 0.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from bench.harness import results
from bench.harness.processes import Processes, answer
from bench.harness.scenes import square
from photonfarm.scene.spec_loading import load_spec

WARM_UP = 2  # samples


@dataclass(frozen=True, slots=True)
class Throughput:
    """One film size: samples per second of either side, medians over the repetitions."""

    spec: str
    size: int
    half_spp: int
    processes: float
    threads: float
    ratio: float  # median of the ratios of neighbouring runs
    ratio_from: float
    ratio_to: float


def serve(pipe: Any, name: str, size: int, threads: int) -> None:
    """A worker: loads the scene, then renders the samples it is sent the numbers of."""
    from photonfarm.renderer.scene import backend

    backend.load(threads=threads)
    from photonfarm.renderer.scene.loaded_scene import LoadedScene

    scene = LoadedScene.load(square(load_spec(name), size))

    def make(numbers: Iterable[int]) -> None:
        for number in numbers:
            make_sample(scene, number)

    make(range(WARM_UP))
    answer(pipe, make)


def make_sample(scene: Any, number: int) -> None:
    """All that a worker renders for one sample; sample n is the same in every process."""
    from photonfarm.scene.modification import sample_modification
    from photonfarm.scene.view import sample_view

    modification = sample_modification(scene.spec, 0, number)
    view = sample_view(scene.spec, modification.key(scene.spec.radiance_id), 0, 0)
    scene.apply(modification)
    scene.buffers(view)
    scene.photons(number)
    scene.render_halves(view, (2 * number, 2 * number + 1))


def samples_per_second(count: int, side: Processes, samples: int) -> float:
    """Have all samples rendered, numbers dealt in turn."""
    return samples / side.ask([range(i, samples, count) for i in range(count)])[0]


def measure(name: str, size: int, options: argparse.Namespace) -> Throughput:
    """Both sides by turns, each first as often as the other."""
    n = options.processes
    sides = [(n, Processes(n, serve, name, size, 1)), (1, Processes(1, serve, name, size, n))]
    speeds: list[tuple[float, float]] = []
    for repetition in range(options.repetitions):
        order = (0, 1) if repetition % 2 == 0 else (1, 0)
        found = {i: samples_per_second(*sides[i], options.samples) for i in order}
        speeds.append((found[0], found[1]))
    for _, side in sides:
        side.end()
    ratios = sorted(processes / threads for processes, threads in speeds)
    return Throughput(
        spec=name,
        size=size,
        half_spp=load_spec(name).transport.half_spp,
        processes=statistics.median(processes for processes, _ in speeds),
        threads=statistics.median(threads for _, threads in speeds),
        ratio=statistics.median(ratios),
        ratio_from=ratios[0],
        ratio_to=ratios[-1],
    )


def page(rows: list[Throughput], options: argparse.Namespace) -> str:
    n = options.processes
    header = ["scene", "image", f"{n} processes × 1 thread, samples/s", f"1 process × {n} threads, samples/s", "ratio"]
    lines = [
        [
            row.spec,
            f"{row.size}², 2 × {row.half_spp} spp",
            f"{row.processes:.2f}",
            f"{row.threads:.2f}",
            f"×{row.ratio:.2f} ({row.ratio_from:.2f} … {row.ratio_to:.2f})",
        ]
        for row in rows
    ]
    return f"""# Processes or threads

The same {options.samples} samples (edit, buffers, photons, two half-estimates each), rendered by {n} processes of one
thread and by one process of {n} threads, {options.repetitions} times by turns; medians. **Ratio**: processes over
threads in neighbouring runs: median (least … greatest). Workers have one thread each (`photonfarm work`,
`photonfarm up --workers`), which is also what makes equal seeds give equal bytes.

{results.table(header, lines)}"""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--spec", default="room", help="a built-in spec; its own film is measured too")
    parser.add_argument("--size", type=int, default=256, help="the other film, size × size")
    parser.add_argument("--samples", type=int, default=12)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--repetitions", type=int, default=5)
    options = parser.parse_args()
    own = load_spec(options.spec).film.width
    rows = [measure(options.spec, size, options) for size in (own, options.size)]
    results.write("workers", page(rows, options), {"rows": [asdict(row) for row in rows]}, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
