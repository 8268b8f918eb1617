#!/usr/bin/env python3
"""What the noise of the photon map costs the network that is given it: the same network, shown more and more photons.

    python bench/photon_noise.py [--rooms NAME …] [--times 1 4 16] [--out DIR]

Takes the experiments of experiments/ that have run in their small size (`make experiments-small`), emits so many times
as many light paths in the held-out configurations, and looks at the images that `light_transport_photons` makes of
them: nothing is trained. PHOTONFARM_SCENES names the folder of the scene files. Exit code 0, whatever comes out; 2 for
a room that has not run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import results
import room_study
from network_errors import Errors, stated
from photonfarm.renderer.jobs.render import SceneRenderer, load_scene, located, photons_of, visibility_of
from photonfarm.shared.core.errors import PhotonfarmError
from photonfarm.shared.core.records import F32, BasePointCloud, Visibility
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.store import Store
from photonfarm.trainer.data.dataset import Batch, fill, fill_photons
from photonfarm.trainer.data.store_source import StoredSample, StoreSource
from photonfarm.trainer.networks.inputs import given
from photonfarm.trainer.predict.trained import TrainedRun
from room_study import References

NAME = "photon_noise"
ROOMS = ["movable-living-room", "movable-living-room-2", "fixed-living-room", "fixed-living-room-2"]
WITH, WITHOUT = "light_transport_photons", "light_transport"
NO_POINTS = np.empty((0, 3), np.float32), np.empty(0, np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What came of one number of light paths."""

    times: int  # as many light paths as in the store
    paths: int
    seen: float  # photons that a view sees, the median
    effective: float  # (Σ p)² / Σ p² of their powers, the median: so many of equal power make as noisy a sum
    photon_map: Errors  # of the image that the network's output is added to
    network: Errors


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """An experiment that has run."""

    name: str
    references: References
    without: Errors  # of `WITHOUT`
    shown: list[Shown]  # by ascending paths


def errors(images: F32, references: References) -> Errors:
    """Of images of one network, in the metric space."""
    return Errors(references.shown_errors(images)[None], references.units)


def measured(name: str, told: argparse.Namespace) -> Room:
    """An experiment's networks on its references. Raises PhotonfarmError where they are not there."""
    folder = told.work / name
    runs = {kind: TrainedRun.load(folder / "runs" / kind) for kind in (WITH, WITHOUT)}
    store = Store(folder / "store")
    scene = store.scene(runs[WITH].scene_id)
    references = References.of(store, scene.spec, told.reference_spp, runs[WITH].settings.hold_out)
    plain = StoreSource(store.root, scene.spec.scene_id)
    without = errors(room_study.images(runs[WITHOUT], plain, references.rows), references)
    room_study.tell(f"{name}: {WITHOUT} {stated(without)}")
    shown = [_shown(runs[WITH], store, references, times) for times in told.times]
    return Room(name, references, without, shown)


def _shown(run: TrainedRun, store: Store, references: References, times: int) -> Shown:
    """With so many times as many light paths as there are in the store."""
    source = StoreSource(store.root, run.scene_id)
    source.refresh()
    base = source.base()
    stored = located(source.spec)
    paths = times * stored.photons.paths
    more = stored.photons.model_copy(update={"paths": paths})
    spec = stored.model_copy(update={"photons": more})
    scene, network = load_scene(spec), run.network(spec, base).eval()
    points = min(run.settings.network.points or len(base[1].position), len(base[1].position))
    memory = Batch.empty(1, points, spec, run.needs)
    maps, made, seen, effective = [], [], [], []
    for row in references.rows:
        (sample,) = source.read_batch([row])
        _fill(memory, sample, scene, spec, base[1])
        with torch.no_grad():
            maps.append(torch.as_tensor(network.known(memory.inputs, network.further(memory.inputs))).numpy().copy())
            made.append(network(memory.inputs).numpy().copy())
        photons = given(memory.inputs.photons)
        power = photons.power[photons.seen].mean(dim=-1).double()
        seen.append(len(power))
        effective.append(float(power.sum() ** 2 / (power**2).sum()) if len(power) else 0.0)
    found = [errors(np.concatenate(images), references) for images in (maps, made)]
    room_study.tell(f"{paths} paths: map {stated(found[0])}, network {stated(found[1])}")
    return Shown(times, paths, float(np.median(seen)), float(np.median(effective)), *found)


def _fill(memory: Batch, sample: StoredSample, scene: SceneRenderer, spec: SceneSpec, cloud: BasePointCloud) -> None:
    """A sample's place, with photons of its configuration that are emitted now and what its view sees of them."""
    scene.apply(sample.modification)
    photons = given(photons_of(scene, sample.modification.key(spec.scene_id))[0])
    seen = visibility_of(scene, sample.view, NO_POINTS, photons).photons
    fill(memory, 0, replace(sample, visibility=Visibility(sample.visibility.points, seen)), spec, cloud)
    fill_photons(given(memory.inputs.photons), 0, photons)


def table(room: Room) -> str:
    """A line for each number of light paths."""
    header = (
        "light paths", "photons that a view sees", "of equal power", "MSE of the photon map (95 %)",
        f"MSE of `{WITH}` (95 %)", "less than × 1 (95 %)", f"more than that of `{WITHOUT}` (95 %)",
    )  # fmt: skip
    first = room.shown[0]
    lines = [
        [
            f"{shown.paths} (× {shown.times})", f"{shown.seen:.0f}", f"{shown.effective:.0f}", stated(shown.photon_map),
            stated(shown.network), stated(first.network.less(shown.network)) if shown is not first else "",
            stated(shown.network.less(room.without)),
        ]
        for shown in room.shown
    ]  # fmt: skip
    return results.table(header, lines)


def page(rooms: Sequence[Room]) -> str:
    """The tables as Markdown."""
    parts = "\n\n".join(
        f"## {room.name}\n\n`{WITHOUT}`: {stated(room.without)}; "
        f"{room_study.counted(len(room.references.rows), 'view')}.\n\n{table(room)}"
        for room in rooms
    )
    return f"""# What the noise of the photon map costs

The networks of `make experiments-small`, as they were trained: with the photons of × 1. Further lines show the same
networks more photons of the same held-out configurations; a photon's power is that of its light path over their number,
so that only the noise differs. The photon map is the image that the network's output is added to
(`photonfarm.trainer.networks.photon_map`): albedo times what the wider window gathers. Nothing is trained: what a
network would reach that had learned from so many photons is not measured, and can be less. Photons seen are medians
over views, and so are those of equal power that would make as noisy a sum, (Σ p)² / Σ p². MSE is in the metric
space, the references' noise taken out. Intervals are over configurations, of a static room over views, for these
networks (one seed).

{parts}

{results.footer(NAME)}"""


def document(rooms: Sequence[Room]) -> dict[str, Any]:
    """The figures of photon_noise.json."""

    def of(found: Errors) -> list[float]:
        return np.round(found.values[0], 6).tolist()  # type: ignore[no-any-return]

    return {
        room.name: {
            "units": [unit.hex() for unit in room.references.units],
            WITHOUT: of(room.without),
            "shown": [
                {
                    "paths": one.paths,
                    "seen": one.seen,
                    "effective": one.effective,
                    "photon_map": of(one.photon_map),
                    WITH: of(one.network),
                }
                for one in room.shown
            ],
        }
        for room in rooms
    }


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help="experiments (%(default)s)")
    parser.add_argument("--times", nargs="+", type=int, default=[1, 4, 16], help="as many light paths (%(default)s)")
    parser.add_argument("--reference-spp", type=int, default=512, help="of the held-out views (%(default)s)")
    where = room_study.ROOT / "build/experiments/small"
    parser.add_argument("--work", type=Path, default=where, help="where they have run (build/experiments/small)")
    results.add_options(parser)
    told = parser.parse_args()
    torch.set_num_threads(1)
    try:
        rooms = [measured(name, told) for name in told.rooms]
    except PhotonfarmError as error:
        parser.error(str(error))
    results.write(NAME, page(rooms), {"rooms": document(rooms)}, told.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
