"""`photonfarm render`: a pass of a view made again, and compared with what the store has of it.

Shape letters: H W image.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photonfarm.core.errors import StoreError
from photonfarm.core.keys import Key
from photonfarm.core.records import F32
from photonfarm.core.statistics import block_z_test
from photonfarm.core.waiting import Log, tell_waiting
from photonfarm.plan.request import sample_key
from photonfarm.renderer.jobs.estimates import halves_of
from photonfarm.renderer.jobs.render import SceneLoader, load_scene, versions
from photonfarm.renderer.jobs.truth import write_halves
from photonfarm.renderer.scene import backend
from photonfarm.scene.modification import Modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import locate, scene_folder
from photonfarm.scene.view import View
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.format import markers
from photonfarm.store.format.shards import round_as_stored
from photonfarm.store.read.find import Query, SceneMatch, is_spec_file, scene_or_spec


@dataclass(frozen=True, slots=True)
class Comparison:
    """How far a pass that was made again is from the stored one."""

    different: int  # values that are not the same to the bit
    values: int
    largest: float  # difference of two values
    relative: float  # root mean square of the differences, over that of the stored values
    z: float  # largest of the block z-test…
    z_limit: float  # …and what chance allows
    other_versions: dict[str, tuple[str, str]]  # packages that are other ones here: that of the store, that of here
    devices: tuple[str, str] = (markers.CPU, markers.CPU)  # what rendered it: that of the store, that of here

    @property
    def is_equal(self) -> bool:
        """Whether all values are the same to the bit."""
        return self.different == 0

    @property
    def exit_code(self) -> int:
        """0: equal to the bit, 1: differs by no more than chance, 4: by more."""
        return 0 if self.is_equal else 1 if self.z < self.z_limit else StoreError.exit_code

    def line(self) -> str:
        """The comparison in words."""
        if self.is_equal:
            return f"equal to the bit, {self.values} values"
        verdict = "within what chance allows" if self.z < self.z_limit else "more than chance allows"
        size = f"by at most {self.largest:.2g}, by {self.relative:.2g} of the image (RMS)"
        test = f"block z-test {self.z:.2g} of {self.z_limit:.2g}: {verdict}"
        line = f"{self.different} of {self.values} values differ, {size}; {test}"
        if self.other_versions:
            others = [f"{name} {there} there, {here} here" for name, (there, here) in self.other_versions.items()]
            line += f"; other versions: {', '.join(others)}"
        if self.devices != (markers.CPU, markers.CPU):  # equal seeds give equal bytes on processors alone
            there, here = self.devices
            line += f"; rendered on {there}, here on {here}: equal in distribution alone"
        return line


@dataclass(frozen=True, slots=True, eq=False)
class Repeated:
    """A pass that was made again."""

    scene_id: str
    row: int | None  # in the store; None for a pass that is not planned
    pass_number: int
    key: str
    exposure: float
    halves: F32  # (2, H, W, 3) as they were rendered
    comparison: Comparison | None  # None if the store does not have this pass

    @property
    def exit_code(self) -> int:
        """That of the comparison; 0 without one."""
        return 0 if self.comparison is None else self.comparison.exit_code

    def document(self) -> dict[str, Any]:
        """The pass and its comparison, for JSON."""
        compared = self.comparison and {**asdict(self.comparison), "equal": self.comparison.is_equal}
        return {"scene": self.scene_id, "row": self.row, "pass": self.pass_number, "key": self.key, "stored": compared}

    def line(self) -> str:
        """The pass and its comparison in words."""
        if self.comparison is None:
            planned = "is not planned" if self.row is None else f"(row {self.row}) is not complete"
            return f"pass {self.pass_number} {planned}: there is nothing to compare it with"
        return f"row {self.row}, pass {self.pass_number}: {self.comparison.line()}"

    def write(self, file: Path) -> None:
        """Write the pass, as `write_halves` does."""
        about = {"scene": self.scene_id, "key": self.key, "pass": self.pass_number}
        write_halves(file, self.halves, self.exposure, about)


def repeat(
    store: str | Path,
    scene: str,
    row: int,
    pass_number: int | None,
    log: Log,
    load: SceneLoader = load_scene,
) -> Repeated:
    """Render the sample in a row again, or another pass of its view, and compare it with the stored one.

    Raises StoreError for a scene or row that is not there, SceneNotHereError if the scene's files are not on this
    machine, IncompleteError if renders stay non-finite.
    """
    opened = Store(store)
    stored = scene_or_spec(opened, scene)
    reader = SceneReader(store, stored.scene_id)
    reader.refresh()
    modification, view, planned_pass = _read_plan(stored, row)
    number = planned_pass if pass_number is None else pass_number
    key = sample_key(stored.spec.radiance_id, modification, view.vector, number)
    at = _row_of(stored, key)
    spec = _spec_as_rendered(opened, stored, key)
    if is_spec_file(scene) and (folder := scene_folder(scene, spec)) is not None:
        source = spec.scene.model_copy(update={"file": str(folder / str(spec.scene.file))})
        spec = spec.model_copy(update={"scene": source})
    spec = locate(spec)
    with tell_waiting(log, f"loading scene {spec.name}"):
        loaded = load(spec)
        loaded.apply(modification)
    with tell_waiting(log, f"rendering pass {number} of the view in row {row}"):
        ((halves, _),) = halves_of(loaded, [(key, view)])
    there = None if at is None or at not in reader.rows else _compare(stored, reader.read(at).radiance, at, halves)
    return Repeated(stored.scene_id, at, number, key.hex(), spec.exposure, halves, there)


def _row_of(stored: SceneStore, key: Key) -> int | None:
    return next(iter(SceneMatch(stored, Query(sample=key)).rows.tolist()), None)


def _spec_as_rendered(opened: Store, stored: SceneStore, key: Key) -> SceneSpec:
    """The scene's spec with the strategy that a sample was rendered by, if it is there."""
    strategy: dict[str, Any] = {}
    holder, visited = stored, set[str]()
    while holder.scene_id not in visited and (row := _row_of(holder, key)) is not None:
        visited.add(holder.scene_id)
        job = row // holder.plans()[0].shard_rows
        if not holder.is_committed(job):
            break
        figures = holder.marker(job)["figures"]
        strategy, other = figures["strategy"], holder.job_rows(job).plan.halves_from
        if other is None or not figures.get("taken_over"):
            break
        holder = opened.scene(other)
    transport = stored.spec.transport.model_copy(update={**strategy, "card": None})
    return stored.spec.model_copy(update={"transport": transport})


def _read_plan(stored: SceneStore, row: int) -> tuple[Modification, View, int]:
    """The configuration, the view and the pass in a row; raises StoreError if no plan has a sample there."""
    plans = stored.plans()
    if plans and row < plans[-1].end_row:
        rows = stored.job_rows(row // plans[0].shard_rows)
        for sample in rows.samples:
            if sample.row == row:
                return rows.modifications[sample.modification_row], rows.views[sample.view_row], sample.pass_
    there = f"rows go up to {plans[-1].first_row + plans[-1].samples - 1}" if plans else "nothing is planned"
    raise StoreError(f"row {row} of scene {stored.scene_id} ({stored.spec.name}): no sample is planned there; {there}")


def _compare(stored: SceneStore, there: F32, row: int, halves: F32) -> Comparison:
    """The comparison of both halves with those in a row; what is rendered is rounded as the store rounds."""
    here = round_as_stored(halves, stored.spec.radiance_exponent)
    difference = here.astype(np.float64) - there
    test = block_z_test(_interleave(here), _interleave(there), blocks=4)
    root = float(np.sqrt(np.mean(there.astype(np.float64) ** 2)))
    figures = stored.marker(row // stored.plans()[0].shard_rows)["figures"]
    installed = {name: (there_, versions().get(name, "not installed")) for name, there_ in figures["versions"].items()}
    return Comparison(
        different=int(np.count_nonzero(here.view(np.uint32) != there.view(np.uint32))),
        values=here.size,
        largest=float(np.abs(difference).max()),
        relative=float(np.sqrt(np.mean(difference**2))) / root if root else 0.0,
        z=test.z_max,
        z_limit=test.z_limit,
        other_versions={name: pair for name, pair in installed.items() if pair[0] != pair[1]},
        devices=(figures.get("device", markers.CPU), backend.device().name),
    )


def _interleave(images: F32) -> F32:
    """Each image as 16 small ones, of every fourth pixel: estimates of nearly the same image, with noise of their own.

    What differs between them beside the noise only makes the test more lenient; two estimates would be too few for it.
    """
    count, height, width, channels = images.shape
    small = images.reshape(count, height // 4, 4, width // 4, 4, channels).transpose(0, 2, 4, 1, 3, 5)
    return small.reshape(16 * count, height // 4, width // 4, channels)
