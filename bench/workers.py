#!/usr/bin/env python3
"""N processes of one thread each against one process of N threads, on the same samples.

    python bench/workers.py [--spec room] [--size 256] [--samples 12] [--processes 2] [--repetitions 5] [--out DIR]

Samples are what a worker makes of a modification: edit, buffers, photons, two half-estimates. Both sides are kept
ready, warmed up, and given the same samples by turns; the time is that until the last process is done. Exit code 0.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

import results

WARM_UP = 2  # samples


@dataclass(frozen=True, slots=True)
class Row:
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
    """A worker: loads the scene, then renders the samples it is sent the numbers of, and says when they are done."""
    from photonfarm.renderer.scene import backend

    backend.load(threads=threads)
    from photonfarm.renderer.scene.loaded_scene import LoadedScene

    scene = LoadedScene.load(spec_of(name, size))
    for number in range(WARM_UP):
        make_sample(scene, number)
    pipe.send("ready")
    while (numbers := pipe.recv()) is not None:
        for number in numbers:
            make_sample(scene, number)
        pipe.send("done")


def spec_of(name: str, size: int) -> Any:
    """The spec with a film of size × size."""
    from photonfarm.shared.scene.spec import load_spec

    spec = load_spec(name)
    return spec.model_copy(update={"film": spec.film.model_copy(update={"width": size, "height": size})})


def make_sample(scene: Any, number: int) -> None:
    """All that a worker renders for one sample; sample n is the same in every process."""
    from photonfarm.shared.scene.modification import sample_modification
    from photonfarm.shared.scene.view import sample_view

    modification = sample_modification(scene.spec, 0, number)
    view = sample_view(scene.spec, modification.key(scene.spec.scene_id), 0, 0)
    scene.apply(modification)
    scene.buffers(view)
    scene.photons(number)
    scene.render_halves(view, (2 * number, 2 * number + 1))


class Side:
    """Processes that share samples among them."""

    def __init__(self, name: str, size: int, processes: int, threads: int) -> None:
        context = multiprocessing.get_context("spawn")  # Dr.Jit does not outlive a fork
        self._pipes, self._processes = [], []
        for _ in range(processes):
            here, there = context.Pipe()
            process = context.Process(target=serve, args=(there, name, size, threads), daemon=True)
            process.start()
            there.close()
            self._pipes.append(here)
            self._processes.append(process)
        for pipe in self._pipes:
            pipe.recv()

    def samples_per_second(self, samples: int) -> float:
        """Have all samples rendered, numbers dealt in turn."""
        start = time.perf_counter()
        for i, pipe in enumerate(self._pipes):
            pipe.send(range(i, samples, len(self._pipes)))
        for pipe in self._pipes:
            pipe.recv()
        return samples / (time.perf_counter() - start)

    def end(self) -> None:
        """Let the processes go."""
        for pipe in self._pipes:
            pipe.send(None)
        for process in self._processes:
            process.join()


def measure(name: str, size: int, options: argparse.Namespace) -> Row:
    """Both sides by turns, each first as often as the other."""
    n = options.processes
    sides = [Side(name, size, n, 1), Side(name, size, 1, n)]
    speeds: list[tuple[float, float]] = []
    for repetition in range(options.repetitions):
        order = (0, 1) if repetition % 2 == 0 else (1, 0)
        found = {i: sides[i].samples_per_second(options.samples) for i in order}
        speeds.append((found[0], found[1]))
    for side in sides:
        side.end()
    ratios = sorted(processes / threads for processes, threads in speeds)
    return Row(
        spec=name,
        size=size,
        half_spp=spec_of(name, size).transport.half_spp,
        processes=statistics.median(processes for processes, _ in speeds),
        threads=statistics.median(threads for _, threads in speeds),
        ratio=statistics.median(ratios),
        ratio_from=ratios[0],
        ratio_to=ratios[-1],
    )


def page(rows: list[Row], options: argparse.Namespace) -> str:
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

{results.table(header, lines)}

{results.footer("workers")}"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spec", default="room", help="a built-in spec; its own film is measured too")
    parser.add_argument("--size", type=int, default=256, help="the other film, size × size")
    parser.add_argument("--samples", type=int, default=12)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--repetitions", type=int, default=5)
    results.add_options(parser)
    options = parser.parse_args()
    from photonfarm.shared.scene.spec import load_spec

    own = load_spec(options.spec).film.width
    rows = [measure(options.spec, size, options) for size in (own, options.size)]
    results.write("workers", page(rows, options), {"rows": [asdict(row) for row in rows]}, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
