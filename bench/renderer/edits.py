"""What a modification costs when the scene is edited in place: new kernels, milliseconds of each part.

    python -m bench.renderer.edits [--spec room living-room-2] [--modifications 40] [--warm-up 2] [--out DIR]

One thread, as in a worker. Every modification is brought about, seen in its buffers, photons and visibility, and
rendered as two half-estimates in one launch, all twice over: with Dr.Jit's history of kernels, which says what each was
and how long it was generated, compiled and run, and without it, as a worker does. The last column is what the history
costs.

Exit code 0 if no kernel was new after the warm-up, 1 otherwise.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from bench.harness import results
from bench.harness.scenes import ready_spec

PARTS = ("trace", "compile", "kernel", "download")
SPECS = ("room", "living-room-2")


@dataclass(slots=True)
class TimedIntegrator:
    """Stands in for an integrator: renders with it, waits for the kernels, and keeps the time."""

    integrator: Any
    rendered_ms: float = 0.0

    def render_seeds(self, *arguments: Any, **more: Any) -> Any:
        """The integrator's images, evaluated."""
        import drjit as dr

        start = time.perf_counter()
        images = self.integrator.render_seeds(*arguments, **more)
        dr.eval(images)
        dr.sync_thread()
        self.rendered_ms = milliseconds(start)
        return images


@dataclass(slots=True)
class ModificationTimes:
    """Milliseconds of every modification after the warm-up."""

    new_in_warm_up: int = 0
    new_after: int = 0
    split: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # with the history
    plain: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # without


def milliseconds(start: float) -> float:
    return 1e3 * (time.perf_counter() - start)


def timed(work: Callable[[], Any]) -> float:
    """Milliseconds until the work and its kernels are done."""
    import drjit as dr

    start = time.perf_counter()
    work()
    dr.sync_thread()
    return milliseconds(start)


def measure(name: str, modifications: int, warm_up: int) -> tuple[Any, ModificationTimes]:
    """The spec, and what its modifications cost."""
    import drjit as dr

    from photonfarm.renderer.scene.loaded_scene import LoadedScene, integrator_of
    from photonfarm.scene.modification import rebuild, rest, sample_modification
    from photonfarm.scene.view import sample_view

    spec = ready_spec(name)
    seen: set[str] = set()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        scene = LoadedScene.load(spec)
        unseen(dr.kernel_history(), seen)
    scene._integrator = watch = TimedIntegrator(integrator_of(spec.transport))
    figures, cloud = ModificationTimes(), scene.base()[1]
    for i in range(modifications):
        modification = sample_modification(spec, 0, i)
        before = sample_modification(spec, 0, i - 1) if i else rest(spec)
        view = sample_view(spec, modification.key(spec.radiance_id), 0, 0)
        position, _ = rebuild(cloud, modification)
        points = np.resize(position, (len(position) + spec.photons.slots, 3))  # as many as with photons
        works: dict[str, Callable[[], Any]] = {
            "edit": partial(scene.apply, modification),
            "buffers": partial(scene.buffers, view),
            "photons": partial(scene.photons, i),
            "visibility": partial(scene.sees, view, points),
        }
        image = partial(scene.render_halves, view, (2 * i, 2 * i + 1))
        # blocking, so that kernels run while they are waited for and not beside the tracing of the next one
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), dr.scoped_set_flag(dr.JitFlag.LaunchBlocking, True):
            dr.kernel_history_clear()
            costs = {part: timed(work) for part, work in works.items()}
            new = unseen(dr.kernel_history(), seen)
            image_ms = timed(image)
            history = dr.kernel_history()
            new += unseen(history, seen)
        split = {**costs, **image_parts(history, watch.rendered_ms, image_ms), "image": image_ms}
        scene.apply(before)
        plain = {part: timed(work) for part, work in works.items()}
        plain["image"] = timed(image)
        if i < warm_up:
            figures.new_in_warm_up += new
            continue
        figures.new_after += new
        collect(figures.split, split)
        collect(figures.plain, plain)
    return spec, figures


def unseen(history: list[dict[str, Any]], seen: set[str]) -> int:
    """Kernels that this process uses for the first time, as by `seen`, which grows.

    They would have to be compiled, whatever an earlier run has left in the cache on disk.
    """
    new = {kernel["hash"] for kernel in history if "hash" in kernel} - seen
    seen |= new
    return len(new)


def image_parts(history: list[dict[str, Any]], rendered_ms: float, image_ms: float) -> dict[str, float]:
    """Milliseconds of an image: what kernels did not take of the integrator's time is tracing, in Python and Dr.Jit."""
    compiling = sum(kernel.get("codegen_time", 0.0) + kernel.get("backend_time", 0.0) for kernel in history)
    running = sum(kernel["execution_time"] for kernel in history)
    return {
        "trace": rendered_ms - compiling - running,
        "compile": compiling,
        "kernel": running,
        "download": image_ms - rendered_ms,
    }


def collect(lists: dict[str, list[float]], values: dict[str, float]) -> None:
    for key, value in values.items():
        lists[key].append(value)


def summary(spec: Any, figures: ModificationTimes, modifications: int) -> dict[str, Any]:
    """The figures of one spec for the JSON file."""

    def both(lists: dict[str, list[float]]) -> dict[str, dict[str, float]]:
        return {
            part: {"median": round(statistics.median(values), 2), "mean": round(statistics.fmean(values), 2)}
            for part, values in lists.items()
        }

    return {
        "spec": spec.name,
        "film": [spec.film.width, spec.film.height],
        "half_spp": spec.transport.half_spp,
        "modifications": modifications,
        "new_kernels_in_warm_up": figures.new_in_warm_up,
        "new_kernels_after": figures.new_after,
        "with_history_ms": both(figures.split),
        "plain_ms": both(figures.plain),
    }


def line(spec: Any, figures: ModificationTimes) -> list[Any]:
    """The spec's line of the table."""
    split, plain = figures.split, figures.plain
    history_cost = statistics.median(split["image"]) / statistics.median(plain["image"])
    return [
        spec.name,
        f"{spec.film.width}×{spec.film.height}, 2 × {spec.transport.half_spp} spp",
        figures.new_after,
        results.median_and_mean(plain["edit"]),
        *(results.median_and_mean(split[part]) for part in PARTS),
        results.median_and_mean(plain["image"]),
        results.median_and_mean(plain["buffers"]),
        results.median_and_mean(plain["photons"]),
        results.median_and_mean(plain["visibility"]),
        f"×{history_cost:.2f}",
    ]


def page(lines: list[list[Any]], modifications: int, warm_up: int) -> str:
    header = ["spec", "image", "new kernels", "edit", *PARTS, "image in all"]
    header += ["buffers", "photons", "visibility", "history"]
    return f"""# Editing in place

{modifications} modifications of each spec, the first {warm_up} of them as warm-up; one thread; milliseconds as median
(mean). An image is the two half-estimates of one view, in one launch. **New kernels**: after the
warm-up; each would be compiled, or fetched from the cache on disk. **Edit**: bringing the scene from one configuration
into the next, Embree's update included. **Trace**: recording the image's kernels, in Python and Dr.Jit. **Compile**:
generating their code anew to find it in the cache, and the compiler itself where it is not there. **Kernel**: running.
**Download**: from Dr.Jit to numpy. **Image in all** is measured by itself, without Dr.Jit's kernel history and without
waiting for each kernel; **visibility** is which points of the cloud the view sees; **history** is what the kernel
history and the waiting cost, as a factor on the image.

{results.table(header, lines)}"""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--spec", nargs="+", default=list(SPECS))
    parser.add_argument("--modifications", type=int, default=40)
    parser.add_argument("--warm-up", type=int, default=2, help="modifications not counted")
    options = parser.parse_args()
    if not 0 <= options.warm_up < options.modifications:
        parser.error(f"--warm-up is {options.warm_up}; allowed are numbers from 0 below --modifications")
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    measured = [measure(name, options.modifications, options.warm_up) for name in options.spec]
    text = page([line(*found) for found in measured], options.modifications, options.warm_up)
    values = {"warm_up": options.warm_up, "specs": [summary(*found, options.modifications) for found in measured]}
    results.write("edits", text, values, options.out, page="cost")
    return int(any(figures.new_after for _, figures in measured))


if __name__ == "__main__":
    sys.exit(main())
