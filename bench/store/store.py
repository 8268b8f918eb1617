"""The store against the bare disk, and its bytes per sample against storing everything with every sample.

    python -m bench.store.store [--spec room] [--size 256] [--samples 256] [--batches 8] [--repetitions 15]
        [--modifications 4] [--folder DIR] [--out DIR]

Reading: random batches of 32 samples into memory that is used again, all of it in the page cache, by the reader of the
store, by zarr-python, and out of plain numpy memmaps of the same values. Writing: whole jobs, handed over as fast as
they are taken, against the same bytes written, synced and linked file by file. Both sides by turns, in one process and
in two at once; every process reads on one thread. Exit code 0.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.harness import results
from bench.harness.contents import Contents, Pool, commit
from bench.harness.processes import Processes, answer
from bench.harness.scenes import square
from bench.store import bytes_per_sample

BATCH = 32
VIEW = ("depth", "albedo", "normal", "point_seen", "photon_seen")
READING = {"ours": "read {}", "checked": "memmaps, {} with checksums"}


@dataclass(frozen=True, slots=True)
class StoreSpeed:
    """One way against the bare one, in a number of processes at once: medians, and ratios of neighbouring runs."""

    what: str
    processes: int
    bare_mb_s: float  # of all processes together, 10^6 bytes
    mb_s: float
    ratio: float  # median
    ratio_from: float
    ratio_to: float
    cpu_ratio: float  # of processor seconds, bare over ours: what the ratio would be if nothing waited for anything


# -------------------------------------------------------------------------------------------------------- the processes


def serve(pipe: Any, kind: str, *options: Any) -> None:
    """A process that does what it is sent the name and arguments of, and answers with processor seconds."""
    import numcodecs.blosc  # type: ignore[import-untyped]

    numcodecs.blosc.set_nthreads(1)
    ways = reading(*options) if kind == "reading" else writing(*options)

    def cpu_s(asked: Sequence[Any]) -> float:
        way, *arguments = asked
        began = time.process_time()
        ways[way](*arguments)
        return time.process_time() - began

    answer(pipe, cpu_s)


def reading(store: Path, scene_id: str, bare: Path) -> dict[str, Callable[..., None]]:
    """Ways to read batches: of radiance alone, or with the buffers."""
    import zarr
    from awscrt.checksums import crc32c  # type: ignore[import-untyped]

    from photonfarm.store import SceneReader
    from photonfarm.store.read.batch import Batch

    reader = SceneReader(store, scene_id)
    rows = reader.refresh()
    memory = {"radiance": Batch.empty(reader.spec, BATCH, buffers=False), "all": Batch.empty(reader.spec, BATCH)}
    maps = {name: np.load(bare / f"{name}.npy", mmap_mode="r") for name in ("radiance", *VIEW)}
    into = {"radiance": memory["all"].radiance, **memory["all"].of_view}
    arrays: Any = zarr.open_group(store / "scenes" / scene_id / "plans/000000", mode="r")
    names = {"radiance": ("radiance",), "all": ("radiance", *VIEW)}

    def bare_copy(what: str, seed: int, batches: int) -> None:
        for batch in draws(rows, seed, batches):
            for name in names[what]:
                for place, row in enumerate(batch):
                    into[name][place] = maps[name][row]

    def ours(what: str, seed: int, batches: int) -> None:
        for batch in draws(rows, seed, batches):
            reader.read_batch(batch, memory[what])

    def bare_checked(what: str, seed: int, batches: int) -> None:
        for batch in draws(rows, seed, batches):
            for name in names[what]:
                for place, row in enumerate(batch):
                    into[name][place] = maps[name][row]
                    crc32c(into[name][place])

    def by_zarr(what: str, seed: int, batches: int) -> None:
        for batch in draws(rows, seed, batches):
            for name in names[what]:
                into[name][...] = arrays[name].oindex[batch]

    for _ in range(3):  # into the page cache, then into the maps
        for first in range(0, len(rows), BATCH):
            reader.read_batch(rows[first : first + BATCH], memory["all"])
        for name, values in maps.items():
            for row in rows:
                into[name][0] = values[row]
    return {"bare": bare_copy, "checked": bare_checked, "ours": ours, "zarr": by_zarr}


def draws(rows: Any, seed: int, batches: int) -> Iterator[list[int]]:
    """Random batches, the same for every way."""
    rng = np.random.default_rng(seed)
    for _ in range(batches):
        yield rng.choice(rows, BATCH, replace=False).tolist()


def writing(store: Path, scene_id: str, bare: Path, pool: Path) -> dict[str, Callable[..., None]]:
    """Ways to write a job: through the store, or the same sizes under the same names."""
    from photonfarm.store import Store

    scene, contents = Store(store).scene(scene_id), Pool.load(pool)
    noise = np.random.default_rng(os.getpid()).integers(0, 256, 1 << 27, np.uint8)  # more than any file

    def ours(job: int) -> None:
        commit(scene, job, contents)

    def bare_files(sizes: dict[str, int]) -> None:
        for name, size in sizes.items():
            final = bare / name
            part = bare / f"{os.getpid()}.partial"
            with part.open("xb", buffering=0) as file:
                if file.write(noise[:size].data) != size:
                    raise OSError(f"{part}: cut short")
                os.fdatasync(file.fileno())
            os.link(part, final)
            part.unlink()
        for folder in sorted({(bare / name).parent for name in sizes}):
            descriptor = os.open(folder, os.O_RDONLY)
            os.fsync(descriptor)
            os.close(descriptor)

    return {"bare": bare_files, "ours": ours}


# ------------------------------------------------------------------------------------------------------- the comparison


def seconds(workers: Processes, asked: Sequence[Any]) -> tuple[float, float]:
    """Have the first processes do one thing each, at once: seconds until the last is done, and of processors."""
    wall_s, cpu_s = workers.ask(asked)
    return wall_s, sum(cpu_s)


def row_of(
    what: str, processes: int, size: float, bare: list[tuple[float, float]], ours: list[tuple[float, float]]
) -> StoreSpeed:
    """The row of neighbouring runs; `size` is the bytes of one run of one process."""
    ratios = sorted(b[0] / o[0] for b, o in zip(bare, ours, strict=True))
    one, other = (size * processes / 1e6 / statistics.median(wall for wall, _ in side) for side in (bare, ours))
    cpu = statistics.median(b[1] / o[1] for b, o in zip(bare, ours, strict=True))
    return StoreSpeed(what, processes, one, other, statistics.median(ratios), ratios[0], ratios[-1], cpu)


def measure_reading(store: Path, scene_id: str, bare: Path, options: argparse.Namespace) -> list[StoreSpeed]:
    """Batches with and without buffers, in one and two processes."""
    workers = Processes(2, serve, "reading", store, scene_id, bare)
    sizes = {name: np.load(bare / f"{name}.npy", mmap_mode="r")[0].nbytes for name in ("radiance", *VIEW)}
    found: list[StoreSpeed] = []
    for what, size in (("radiance", sizes["radiance"]), ("all", sum(sizes.values()))):
        for processes in (1, 2):
            times: dict[str, list[tuple[float, float]]] = {way: [] for way in ("bare", *READING, "zarr")}
            for i in range(options.repetitions):
                for way in turned(["bare", *READING], i):
                    times[way].append(
                        seconds(workers, [(way, what, 2 * i + p, options.batches) for p in range(processes)])
                    )
                if i < zarr_runs(options):
                    times["zarr"].append(seconds(workers, [("zarr", what, 2 * i + p, 1) for p in range(processes)]))
            read = size * BATCH
            for way, title in READING.items():
                size_of_run = read * options.batches
                found.append(row_of(title.format(what), processes, size_of_run, times["bare"], times[way]))
            bare_one = [
                (wall / options.batches, cpu / options.batches) for wall, cpu in times["bare"][: zarr_runs(options)]
            ]
            found.append(row_of(f"zarr-python {what}", processes, read, bare_one, times["zarr"]))
    workers.end()
    return found


def measure_writing(scene: Any, pool: Path, bare: Path, options: argparse.Namespace) -> list[StoreSpeed]:
    """Whole jobs, in one and two processes; the bare files of a job have the sizes of the first one's."""
    workers = Processes(2, serve, "writing", scene.storage.where, scene.scene_id, bare, pool)
    jobs = iter(scene.missing_jobs())
    first = next(jobs)
    seconds(workers, [("ours", first)])
    for name in renamed(scene, first, first):
        (bare / name).parent.mkdir(parents=True, exist_ok=True)
    found: list[StoreSpeed] = []
    for processes in (1, 2):
        times: dict[str, list[tuple[float, float]]] = {"bare": [], "ours": []}
        for i in range(options.repetitions):
            for way in turned(list(times), i):
                chosen = [next(jobs) for _ in range(processes)]
                given = [renamed(scene, first, job) for job in chosen] if way == "bare" else chosen
                times[way].append(seconds(workers, [(way, one) for one in given]))
        size = sum(renamed(scene, first, first).values())
        found.append(row_of("write jobs", processes, size, times["bare"], times["ours"]))
    workers.end()
    return found


def renamed(scene: Any, done: int, job: int) -> dict[str, int]:
    """The sizes of a job's files, under the names of another's."""
    files = scene.marker(done)["files"].items()
    return {name.replace(f"/c.{done}", f"/c.{job}"): about["size"] for name, about in files}


def zarr_runs(options: argparse.Namespace) -> int:
    """The number of runs through zarr-python, which is slow: a fifth of the others."""
    return int(max(1, options.repetitions // 5))


def turned(ways: list[str], i: int) -> list[str]:
    """Each first as often as any other."""
    return ways[i % len(ways) :] + ways[: i % len(ways)]


def bare_arrays(store: Path, scene_id: str, folder: Path) -> None:
    """The samples of a store as one plain .npy file for each array, a row for each sample."""
    from photonfarm.store import SceneReader

    reader = SceneReader(store, scene_id)
    rows = reader.refresh()
    folder.mkdir()
    batch = reader.read_batch(rows[:1])
    shapes = {"radiance": batch.radiance, **batch.of_view}
    out = {
        name: np.lib.format.open_memmap(folder / f"{name}.npy", "w+", values.dtype, (len(rows), *values.shape[1:]))
        for name, values in shapes.items()
    }
    for place, row in enumerate(rows):
        batch = reader.read_batch([row], batch)
        for name, values in {"radiance": batch.radiance, **batch.of_view}.items():
            out[name][place] = values[0]


# ------------------------------------------------------------------------------------------------------------- the page


def cell(row: bytes_per_sample.StoreSize) -> str:
    return f"{row.bytes_per_sample / 1e3:.0f} kB (÷{row.saving:.1f}), {row.with_guides / 1e3:.0f} kB"


def page(
    speeds: list[StoreSpeed],
    sizes: tuple[list[bytes_per_sample.StoreSize], bytes_per_sample.Whole, int],
    options: Any,
    spec: Any,
) -> str:
    rows, whole, base = sizes
    lines = [
        [
            r.what,
            r.processes,
            f"{r.bare_mb_s:.0f}",
            f"{r.mb_s:.0f}",
            f"{r.ratio:.2f} ({r.ratio_from:.2f} … {r.ratio_to:.2f})",
            f"{r.cpu_ratio:.2f}",
        ]
        for r in speeds
    ]
    header = ["what", "processes", "bare, MB/s", "store, MB/s", "ratio", "ratio of processor time"]
    by = {(r.views_per_modification, r.passes): r for r in rows}
    grid = [
        [f"{views} views", *(cell(by[views, passes]) for passes in bytes_per_sample.COUNTS)]
        for views in bytes_per_sample.COUNTS
    ]
    parts = {part: f"{value / 1e3:.0f} kB" for part, value in asdict(whole).items()}
    film = f"{spec.film.width} × {spec.film.height}"
    return f"""# The store against the bare disk

`{options.spec}` at {film}. Everything is in the page cache when it is read. **Bare** reading: the rows copied out of
plain numpy memmaps of the same values, unchecked and uncompressed; **store**: `SceneReader.read_batch` into the same
kind of reused memory, every byte checked; **memmaps with checksums**: the bare way, with the CRC-32C taken of what has
arrived and compared with nothing. MB/s are those of the decoded values. *All* is
radiance (stored raw) with depth, albedo and normal (compressed).

**Bare** writing: files of the same names and sizes as the job's, each written at once, synced and linked, then their
folders synced; **store**: a job of {BATCH} samples from its first row to its marker, handed over as fast as it is
taken: it checks, scales, rounds to float16 and compresses the rows in one thread, in a worker the one that renders, and
another gives them checksums and writes them. [farm.md](farm.md) has the share of a worker's time that the store takes
(store overhead). MB/s are those of the bytes on the disk, equal on both sides. {options.repetitions} runs by turns
({zarr_runs(options)} of zarr-python); medians; ratios of neighbouring runs: median (least … greatest).

{results.table(header, lines)}

## Bytes per sample

All files of a store of {options.modifications} modifications, without its base ({base / 1e3:.0f} kB, once per
scene), over its samples; in brackets how many times less that is than **{whole.total / 1e3:.0f} kB**: a sample stored
with all that it is trained on, in the same shards and codecs. That is radiance {parts["radiance"]}, buffers
{parts["buffers"]}, the moved cloud of {spec.points} points {parts["cloud"]} (position, normal, albedo, emission,
visibility) and {spec.photons.paths} × {spec.photons.depth} photons {parts["photons"]}. The radiance, two half-estimates
in float16, is what no sample can share. Behind it: with the guides of its views, which networks may be given.

{results.table(["per modification", *(f"{n} passes per view" for n in bytes_per_sample.COUNTS)], grid)}"""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--spec", default="room", help="a built-in spec")
    parser.add_argument("--size", type=int, default=256, help="film, size × size")
    parser.add_argument("--samples", type=int, default=256, help="to draw batches from; should fit the memory well")
    parser.add_argument("--batches", type=int, default=8, help="per run")
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--modifications", type=int, default=4, help="in the stores of the table of bytes")
    parser.add_argument("--folder", type=Path, help="on the disk to measure (that of temporary files)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        speeds, sizes, spec = run(Path(folder), options)
    rows, whole, base = sizes
    values: dict[str, Any] = {"speed": [asdict(row) for row in speeds], "bytes": [asdict(row) for row in rows]}
    values |= {"whole": asdict(whole), "base_bytes": base}
    results.write("store", page(speeds, sizes, options, spec), values, options.out)
    return 0


def run(folder: Path, options: argparse.Namespace) -> tuple[list[StoreSpeed], Any, Any]:
    """All measurements: the bytes, which renders the contents, then reading and writing."""
    from photonfarm.plan.request import Request
    from photonfarm.scene.spec_loading import load_spec

    spec = square(load_spec(options.spec), options.size)
    contents = Contents(spec)
    sizes = bytes_per_sample.measure(spec, contents, options.modifications, folder / "bytes")
    pool = contents.pool()
    pool.save(folder / "pool.npz")
    scene = bytes_per_sample.filled(spec, pool, Request(modifications=options.samples), folder / "read")
    bare_arrays(folder / "read", scene.scene_id, folder / "bare")
    speeds = measure_reading(folder / "read", scene.scene_id, folder / "bare", options)
    request = Request(modifications=BATCH * (6 * options.repetitions + 1), seed=1)
    scene = bytes_per_sample.planned(spec, request, folder / "write")
    speeds += measure_writing(scene, folder / "pool.npz", folder / "bare-write", options)
    return speeds, sizes, spec


if __name__ == "__main__":
    sys.exit(main())
