"""Rays per second of `bdpt` against bare calls of Mitsuba on the same rays, which no integrator can beat.

    python -m bench.renderer.rays [--scene cornell room ...] [--size 128] [--spp 8] [--repetitions 5] [--out DIR]
        [--connections 1] [--light-ratio 1] [--max-depth 8]

A render writes down each ray that it traces: call by call, in the order each call traces them. These are traced again
by `scene.ray_intersect_preliminary` and `scene.ray_test` alone, by turns with further renders of the same seed. One
thread; times are CPU time, medians. Exit code 0, or 2 for an unknown scene.
"""

from __future__ import annotations

import argparse
import gc
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from bench.harness import results
from bench.renderer import scene_loading

SCENES = ("cornell", "room", "kitchen", "bathroom", "living-room-2", "veach-ajar", "cove", "glass_caustic")
SEED = 7


METHODS = ("ray_intersect", "ray_intersect_preliminary", "ray_test")


class Record:
    """The rays of one call, in the order they were traced, written from inside the kernel that traces them."""

    def __init__(self, capacity: int) -> None:
        import drjit as dr
        import mitsuba as mi

        self.capacity = capacity
        self.columns = dr.zeros(mi.Point3f, capacity), dr.zeros(mi.Vector3f, capacity), dr.zeros(mi.Float, capacity)
        self._next = dr.zeros(mi.UInt32, 1)
        dr.eval(self.columns, self._next)

    def add(self, ray: Any, active: Any) -> None:
        """Write down the active rays. Once only: within a loop a counter cannot be used twice."""
        import drjit as dr
        import mitsuba as mi

        slot = dr.scatter_inc(self._next, mi.UInt32(0), mi.Bool(active))
        fits = mi.Bool(active) & (slot < self.capacity)
        for column, values in zip(self.columns, (ray.o, ray.d, ray.maxt), strict=True):
            dr.scatter(column, values, slot, fits)

    def count(self) -> int:
        """How many there are. Raises RuntimeError if there was no room for some."""
        count = int(self._next[0])
        if count > self.capacity:
            raise RuntimeError(f"{count} rays were traced by one call, and there is room for {self.capacity}")
        return count

    def rays(self) -> Any:
        """All of them, one at least, as one Ray3f."""
        import drjit as dr
        import mitsuba as mi

        chosen = dr.arange(mi.UInt32, self.count())
        origin, direction, maxt = (dr.gather(type(column), column, chosen) for column in self.columns)
        ray = mi.Ray3f(origin, direction)
        ray.maxt = maxt
        dr.eval(ray)
        dr.sync_thread()
        return ray


@contextmanager
def calls_seen(see: Callable[[str, Any, Any], None]) -> Iterator[None]:
    """While this lasts, `see` gets the method, rays and mask of every call by which Python traces rays."""
    import mitsuba as mi

    kept = {name: getattr(mi.Scene, name) for name in METHODS}

    def seen(name: str) -> Callable[..., Any]:
        def method(scene: Any, ray: Any, *arguments: Any, **more: Any) -> Any:
            see(name, ray, more["active"] if "active" in more else arguments[-1] if arguments else True)
            return kept[name](scene, ray, *arguments, **more)

        return method

    for name in METHODS:
        setattr(mi.Scene, name, seen(name))
    try:
        yield
    finally:
        for name, method in kept.items():
            setattr(mi.Scene, name, method)


def recorded_rays(render: Callable[[], None], capacity: int) -> tuple[list[Any], list[Any]]:
    """Closest-hit rays and shadow rays of a render, one Ray3f for each call that it makes."""
    import drjit as dr

    calls: list[tuple[Any, ...]] = []
    used: list[tuple[str, Record]] = []

    def write_down(name: str, ray: Any, active: Any) -> None:
        record = unused.pop()
        record.add(ray, active)
        used.append((name, record))

    # A frozen function is replayed without the Python that calls for rays
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        with calls_seen(lambda *call: calls.append(call[:1])):
            render()
        unused = [Record(capacity) for _ in calls]
        with calls_seen(write_down):
            render()
    # Dr.Jit may trace the body of a loop twice and use the second: the record of the first stays empty
    rays = [(name, record.rays()) for name, record in used if record.count()]
    closest = [ray for name, ray in rays if name != "ray_test"]
    return closest, [ray for name, ray in rays if name == "ray_test"]


@dataclass(frozen=True, slots=True)
class RayCost:
    """One scene: rays traced, and CPU seconds (medians)."""

    scene: str
    closest_hit_rays: int
    shadow_rays: int
    render_s: float
    bare_s: float  # ray_intersect_preliminary and ray_test
    render_kernels_s: float  # seconds in which the kernels of render_s ran
    bare_kernels_s: float
    surfaces_kernels_s: float  # ray_intersect with what it tells of the surface, and ray_test

    @property
    def rays(self) -> int:
        """All rays of a render."""
        return self.closest_hit_rays + self.shadow_rays


def seconds(work: Callable[[], Any]) -> tuple[float, float]:
    """(CPU seconds of this process until the work and its kernels are done, seconds in which kernels ran)."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        start = time.process_time()
        work()
        dr.sync_thread()
        spent = time.process_time() - start
        return spent, sum(kernel["execution_time"] for kernel in dr.kernel_history()) / 1e3


def measure(name: str, options: argparse.Namespace) -> RayCost:
    """Render, record, and trace the record again."""
    import drjit as dr
    import mitsuba as mi

    scene = scene_loading.load(name, options.size)
    integrator = mi.load_dict(
        {
            "type": "bdpt",
            "record": True,
            "max_depth": options.max_depth,
            "connections": options.connections,
            "light_ratio": options.light_ratio,
        }
    )

    def render() -> None:
        dr.eval(integrator.render(scene, sensor=0, seed=SEED, spp=options.spp))

    paths = options.size**2 * options.spp * max(1.0, options.light_ratio)
    closest, shadow = recorded_rays(render, int(paths * options.max_depth))
    works = {
        "render": render,
        "preliminary": lambda: [dr.eval(scene.ray_intersect_preliminary(rays).t) for rays in closest],
        "surfaces": lambda: [dr.eval(surface_sum(scene.ray_intersect(rays))) for rays in closest],
        "shadow": lambda: [dr.eval(scene.ray_test(rays)) for rays in shadow],
    }
    for work in (*works.values(), render):
        seconds(work)  # compiles; a frozen render is recorded by its first run and prepared by its second
    measured: dict[str, list[tuple[float, float]]] = {part: [] for part in works}
    for _ in range(options.repetitions):
        for part, work in works.items():
            measured[part].append(seconds(work))
    cpu = {part: statistics.median(found[0] for found in runs) for part, runs in measured.items()}
    kernels = {part: statistics.median(found[1] for found in runs) for part, runs in measured.items()}
    return RayCost(
        scene=name,
        closest_hit_rays=sum(dr.width(rays) for rays in closest),
        shadow_rays=sum(dr.width(rays) for rays in shadow),
        render_s=cpu["render"],
        bare_s=cpu["preliminary"] + cpu["shadow"],
        render_kernels_s=kernels["render"],
        bare_kernels_s=kernels["preliminary"] + kernels["shadow"],
        surfaces_kernels_s=kernels["surfaces"] + kernels["shadow"],
    )


def surface_sum(si: Any) -> Any:
    """One number of all that an integrator asks of a surface, so that all of it is computed and little is stored."""
    import drjit as dr

    vectors = (si.p, si.n, si.sh_frame.n, si.sh_frame.s, si.sh_frame.t, si.wi)
    return si.t + dr.sum(si.uv) + sum(dr.sum(vector) for vector in vectors)


def page(rows: list[RayCost], options: argparse.Namespace) -> str:
    header = ["scene", "closest-hit rays", "shadow rays", "bdpt, Mrays/s", "bare, Mrays/s", "fraction"]
    header += ["fraction of kernels", "of kernels, with surfaces"]
    lines = [
        [
            row.scene,
            f"{row.closest_hit_rays:,}",
            f"{row.shadow_rays:,}",
            f"{row.rays / row.render_s / 1e6:.2f}",
            f"{row.rays / row.bare_s / 1e6:.2f}",
            f"{row.bare_s / row.render_s:.2f}",
            f"{row.bare_kernels_s / row.render_kernels_s:.2f}",
            f"{row.surfaces_kernels_s / row.render_kernels_s:.2f}",
        ]
        for row in rows
    ]
    settings = f"connections {options.connections}, light ratio {options.light_ratio:g}, max_depth {options.max_depth}"
    return f"""# Rays per second

`bdpt` ({settings}) at {options.size}², {options.spp} spp, and the bare calls `scene.ray_intersect_preliminary` and
`scene.ray_test` on the very rays that it traced, call by call and each call's in the order it traced them: the limit
for any integrator that traces these rays. One thread, CPU time, medians of {options.repetitions}. **bdpt**: all rays
over all of its time, tracing in Python included. **Fraction**: of the limit. **Of kernels**: the same for the kernels
alone. **With surfaces**: of the kernels' limit with `scene.ray_intersect`, which also finds position, frame and texture
coordinates of each hit. The bare calls find their rays packed without gaps; in `bdpt` the lanes of ended paths stay
empty.

{results.table(header, lines)}"""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--scene", nargs="+", default=list(SCENES))
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--spp", type=int, default=8)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--connections", type=int, default=1)
    parser.add_argument("--light-ratio", type=float, default=1.0)
    parser.add_argument("--max-depth", type=int, default=8)
    options = parser.parse_args()
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    rows = []
    for name in options.scene:
        try:
            rows.append(measure(name, options))
        except ValueError as error:
            print(f"rays: {error}", file=sys.stderr)
            return 2
        gc.collect()
    results.write("rays", page(rows, options), {"rows": [asdict(row) for row in rows]}, options.out, page="cost")
    return 0


if __name__ == "__main__":
    sys.exit(main())
