"""`photonfarm scene free-space`: where cameras of a scene may stand, measured by rays.

The box of origins is divided into cells. A cell is free if its middle is inside no solid (`scene.surroundings`), no ray
from there meets a surface within the cell, and it sees some of the box of look-at points: outside of a room, or in the
next one, walls are between. Then the same holds of all of the cell. Movable groups are away meanwhile; each takes the
box around it, wherever it stands.

Shape letters: N cells; X Y Z cells along the axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.core.records import F32
from photonfarm.core.waiting import Log
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.scene.surroundings import NONE, have_sight, uniform_in
from photonfarm.scene.free_space import FreeSpace, pack
from photonfarm.scene.groups import shape_ids
from photonfarm.scene.modification import rest, sample_modifications
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import are_in_free_space

ALONG = 48
"""The cells along the longest side of the box of origins."""

CONFIGURATIONS, ORIGINS = 64, 512
"""The random configurations, and the random origins in each, in which the free share of the box is measured."""

LEAST = 0.02
"""The share of the box that must be free, so that drawing cameras in it ends soon."""


class NothingFreeError(SpecError):
    """No camera of a spec, or hardly any, stands in the open."""


@dataclass(frozen=True, slots=True)
class Measured:
    """The free space of a scene."""

    space: FreeSpace
    cell: float  # the longest side of a cell, scene units
    still: float  # the share of the box of origins that is free without movable groups
    free: float  # with them, in the mean over configurations

    def line(self) -> str:
        """All of it in words."""
        return (
            f"cameras may stand in {self.still:.0%} of the box of origins ({' × '.join(map(str, self.space.cells))} "
            f"cells of up to {self.cell:.2g}), and in {self.free:.0%} of it beside the groups of a random configuration"
        )

    def entry(self) -> dict[str, Any]:
        """The table `view.free_space` of a spec."""
        return self.space.model_dump(mode="json")


def measure(spec: SceneSpec, beside: Path | None, log: Log) -> Measured:
    """Measure free space by rays; raises SpecError as loading does, NothingFreeError where little is free."""
    log(f"loading {spec.name}")
    scene = LoadedScene.load(spec, beside)
    groups = _group_boxes(scene)
    middles, sides = _middles(spec)
    log(f"looking around from {np.prod(middles.shape[:3])} places in the box of origins of {spec.name}")
    free = _free(scene, middles.reshape(-1, 3), 0.5 * np.linalg.norm(sides)).reshape(middles.shape[:3])
    if not free.any():
        raise NothingFreeError(
            f"{spec.name}: view.origin: no camera in it stands in the open; move the box into the room"
        )
    x, y, z, _ = middles.shape
    space = FreeSpace(of=spec.free_space_digest, cells=(x, y, z), free=pack(free), groups=groups)
    result = Measured(space, float(sides.max()), float(free.mean()), _share(spec, space))
    if result.free < LEAST:
        raise NothingFreeError(
            f"{spec.name}: view.origin: only {result.free:.1%} of it is free beside the groups of a configuration; "
            "make the box larger, or let groups leave room in it"
        )
    return result


def _free(scene: LoadedScene, middles: F32, reach: np.floating) -> NDArray[np.bool_]:
    """Whether cells with these middles (N, 3) are free, given how far their corners are from there, (N,).

    Movable groups are away.
    """
    spec = scene.spec
    scene.apply(rest(spec).without_groups())
    around = scene.surroundings(middles)
    clear = around.clearance > reach + spec.view.near
    free: NDArray[np.bool_] = clear & have_sight(scene, middles) & (around.solid == NONE)
    return free


def _middles(spec: SceneSpec) -> tuple[F32, NDArray[np.float64]]:
    """The middles of all cells (X, Y, Z, 3), and the sides of a cell (3,)."""
    low, high = spec.view.origin.low, spec.view.origin.high
    longest = (high - low).max()
    count = np.maximum(np.ceil(ALONG * (high - low) / longest), 1).astype(int) if longest else np.ones(3, int)
    sides = (high - low) / count
    axes = [low[i] + sides[i] * (np.arange(count[i]) + 0.5) for i in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32), sides


def _group_boxes(scene: LoadedScene) -> dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]]:
    """The box around each group, from its `at`, larger by what the near plane would cut open."""
    spec = scene.spec
    margin = 2 * spec.view.near
    number = {shape.id(): i for i, shape in enumerate(scene.scene.shapes())}
    boxes = scene.boxes.astype(np.float64)
    around = {}
    for group in spec.groups:
        if not (shapes := [number[shape] for shape in shape_ids(group) if shape in number]):
            continue  # a light without a shape
        own = boxes[shapes]
        low, high = (own[:, 0].min(axis=0) - margin, own[:, 1].max(axis=0) + margin)
        around[group.name] = (_round(low - np.array(group.at)), _round(high - np.array(group.at)))
    return around


def _round(corner: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (float(f"{value:.5g}") for value in corner)
    return x, y, z


def _share(spec: SceneSpec, space: FreeSpace) -> float:
    """The share of the box of origins that is free, in the mean over random configurations."""
    with_space = spec.model_copy(update={"view": spec.view.model_copy(update={"free_space": space})})
    vectors = np.repeat(sample_modifications(with_space, 0, range(CONFIGURATIONS)), ORIGINS, axis=0)
    return float(are_in_free_space(with_space, uniform_in(spec.view.origin, len(vectors)), vectors).mean())
