#!/usr/bin/env python3
"""What the places of lights, and those of objects, change in the images of rooms in which both move.

    python bench/moved_lights.py [--rooms room movable-living-room …] [--views 24] [--half-spp 32] [--out DIR]

Renders random views three times: as they are, with the lights as in another random configuration, and with the objects
as in another. A room is a built-in spec, or an experiment of experiments/ in its small size; PHOTONFARM_SCENES names
the folder of the rooms' scene files. Exit code 0, whatever comes out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

import results
import room_study
from photonfarm.renderer.jobs.render import SceneRenderer, load_scene, located
from photonfarm.shared.core.errors import PhotonfarmError
from photonfarm.shared.core.estimate import Estimate
from photonfarm.shared.core.records import ViewBuffers
from photonfarm.shared.scene.modification import Modification, sample_modification
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.scene.view import View, sample_view
from photonfarm.trainer.metrics import metric_space
from photonfarm.trainer.metrics.intervals import confidence_interval

NAME = "moved_lights"
ROOMS = ["room", "movable-living-room", "movable-living-room-2", "movable-dining-room", "movable-veach-ajar"]
SEED = 1
SAME_DEPTH = 1e-3  # relative: so near, and of the same normal, is the same surface


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """A view of one configuration."""

    halves: NDArray[np.float64]  # (2, H, W, 3) in the metric space
    buffers: ViewBuffers


@dataclass(frozen=True, slots=True)
class Change:
    """Half the mean squared difference of two images, of each view: the variance of what was drawn anew."""

    whole: list[float]
    same_surface: list[float]  # of the pixels that show one surface in both; without views in which none does


@dataclass(frozen=True, slots=True)
class Room:
    """What was measured of a room."""

    name: str
    lights: Change
    objects: Change


def mixed(first: Modification, second: Modification, spec: SceneSpec, *, lights: bool) -> Modification:
    """The first configuration with the lights of the second, or with its objects; objects come first."""
    count = len(spec.objects)
    objects, lit = (first, second) if lights else (second, first)
    return Modification.from_vector(np.concatenate([objects.vector[:count], lit.vector[count:]]))


def shown(scene: SceneRenderer, spec: SceneSpec, modification: Modification, view: View, seeds: Sequence[int]) -> Image:
    """A view, rendered in two halves."""
    scene.apply(modification)
    halves = (spec.exposure * scene.render_halves(view, seeds)).astype(np.float32)
    return Image(metric_space(halves).double().numpy(), scene.buffers(view))


def same_surface(a: ViewBuffers, b: ViewBuffers) -> NDArray[np.bool_]:
    """The pixels that show one surface in both, (H, W)."""
    near = np.abs(a.depth - b.depth) <= SAME_DEPTH * np.maximum(a.depth, b.depth)
    same: NDArray[np.bool_] = near & (np.abs(a.normal - b.normal).max(axis=-1) < SAME_DEPTH)
    return same & (a.depth > 0)


def half_square(a: Image, b: Image, where: NDArray[np.bool_]) -> float:
    """(A₁ − A₂)(B₁ − B₂) / 2, the mean over some pixels: the noise of the halves multiplies to nothing."""
    differences = a.halves - b.halves
    return float((differences[0] * differences[1])[where].mean() / 2)


def measured(name: str, views: int, half_spp: int) -> Room:
    """Render a room's views. Raises PhotonfarmError where that cannot be."""
    spec = located(room_study.in_passes(room_study.named_room(name), half_spp))
    scene = load_scene(spec)
    found: dict[str, tuple[list[float], list[float]]] = {"lights": ([], []), "objects": ([], [])}
    for index in range(views):
        drawn, other = (sample_modification(spec, SEED, 2 * index + which) for which in range(2))
        view = sample_view(spec, drawn.key(spec.scene_id), SEED, 0)
        first = shown(scene, spec, drawn, view, (6 * index, 6 * index + 1))
        for number, (what, (whole, same)) in enumerate(found.items(), 1):
            seeds = 6 * index + 2 * number, 6 * index + 2 * number + 1
            second = shown(scene, spec, mixed(drawn, other, spec, lights=what == "lights"), view, seeds)
            unchanged = same_surface(first.buffers, second.buffers)
            whole.append(half_square(first, second, np.ones_like(unchanged)))
            if unchanged.any():
                same.append(half_square(first, second, unchanged))
    room = Room(name, *(Change(*lists) for lists in found.values()))
    room_study.tell(f"{name}: lights {stated(room.lights.whole)}, objects {stated(room.objects.whole)}")
    return room


def stated(values: Sequence[float]) -> str:
    """Mean, 95 % interval by Student's t, as views are of different configurations, and median."""
    found, median = Estimate.of(np.array(values)), f"{np.median(values):.5f}"
    limits = confidence_interval(found)
    return f"{found.mean:.5f}" if limits is None else f"{found.mean:.5f} ({limits[0]:.5f} … {limits[1]:.5f}), {median}"


def page(rooms: Sequence[Room], views: int, half_spp: int) -> str:
    """The table as Markdown."""
    header = (
        "room", "lights anew: mean (95 %), median", "on surfaces that stay in view",
        "objects anew: mean (95 %), median", "likewise",
    )  # fmt: skip
    lines = (
        [
            room.name, stated(room.lights.whole), stated(room.lights.same_surface), stated(room.objects.whole),
            stated(room.objects.same_surface),
        ]
        for room in rooms
    )  # fmt: skip
    return f"""# What the places of lights and of objects change in an image

{views} random views of random configurations of each room, at 64 × 64, each rendered again with the lights, and then
with the objects, as in another random configuration. Given is half the mean squared difference in the metric space,
clip(exposure · I, 0, 1)^(1/2.2), with the noise taken out by halves of {half_spp} spp: the variance over what was
drawn anew, and so the least MSE of whoever knows all but that. What that curve makes of the noise is left in, and where
little changes a value may come out negative. The other columns leave out the pixels in which another surface comes to
be seen, which buffers tell, and views in which none is left. The lamp of `room` counts as an object, as it
takes its light along. Means are carried by few views, so that their intervals are rough.

{results.table(header, lines)}

{results.footer(NAME)}"""


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help="(%(default)s)")
    parser.add_argument("--views", type=int, default=24, help="of each room (%(default)s)")
    parser.add_argument("--half-spp", type=int, default=32, help="samples per pixel of a half (%(default)s)")
    results.add_options(parser)
    told = parser.parse_args()
    try:
        rooms = [measured(name, told.views, told.half_spp) for name in told.rooms]
    except PhotonfarmError as error:
        parser.error(str(error))
    document = {"views": told.views, "half_spp": told.half_spp, "rooms": {room.name: asdict(room) for room in rooms}}
    results.write(NAME, page(rooms, told.views, told.half_spp), document, told.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
