"""What cannot be right in a spec, or is worth a look, as a check of its scene measured it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from photonfarm.core.formatting import format_share
from photonfarm.core.records import F32
from photonfarm.renderer.tools.check.samples import Cameras, Samples
from photonfarm.renderer.tools.check.shapes import Placed
from photonfarm.renderer.tools.measure.exposure import TARGET
from photonfarm.scene.groups import Movable
from photonfarm.scene.plausibility import doubts, group_key
from photonfarm.scene.poor_views import hand_of
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import SpecLines

MEANS = (0.2, 0.7)
"""Display means between which nothing is said."""

INSIDE = NEAR = 0.02
BEHIND = 0.01
EMPTY = 0.01
BLACK_BACKS = 0.05
"""The shares of cameras, and of what they see, from which on something is said."""

PLACED_WELL = 0.75
"""The least share of cameras in the open from which pictures show how bright the scene is."""

LEAST_SEEN = 0.01
SEES_LITTLE = 0.05
"""Something is said if such a share of the views sees less than such a share of the points."""

FAR = 10.0
"""A scene whose middle is farther from the origin than so many of its diagonals has rough coordinates."""

OUTSIDE = 0.05
CUT = 0.2
CUT_AT_ALL = 0.05
"""The shares of a group's places from which on something is said."""


_VIEWS = {"view.origin", "view.look_at", "view.far", "view.near", "view.fov_deg", "view.fov"}
"""The keys of a spec that, where they are doubted, explain what cameras do not see."""
_DARKNESS = {"transport.max_depth", "emitters", "scene"}
"""Those that explain why pictures are dark."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding, and what to change."""

    key: str  # of the spec
    sentence: str
    serious: bool = True  # otherwise it is worth a look

    def line(self, lines: SpecLines) -> str:
        """The finding after its line in the spec's file."""
        return f"{lines.place(self.key)}: {self.sentence}"

    def document(self, lines: SpecLines) -> dict[str, Any]:
        """All of it, for JSON."""
        return {**asdict(self), "file": str(lines.file), "line": lines.line(self.key)}


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """All that a check measured."""

    low: F32  # (3,) the scene's box at rest
    high: F32
    placed: Sequence[Placed]  # by the spec's groups
    samples: Samples


def collect_findings(spec: SceneSpec, lights: frozenset[str], measured: Measured) -> list[Finding]:
    """The findings, serious ones first; one for each key, and none that only follows from another."""
    by_key: dict[str, Finding] = {}
    cameras = measured.samples.cameras
    _add(by_key, _check_place(spec, measured))
    _add(by_key, (Finding(*doubt) for doubt in doubts(spec, lights)))
    if not _VIEWS & by_key.keys():
        _add(by_key, _check_cameras(spec, cameras))
        if not _DARKNESS & by_key.keys() and cameras.placed_well.mean() >= PLACED_WELL:
            _add(by_key, _check_brightness(spec, measured.samples))
    for index, (group, placed) in enumerate(zip(spec.groups, measured.placed, strict=True)):
        _add(by_key, _check_group(spec, group, placed, group_key(spec, index)))
    return sorted(by_key.values(), key=lambda finding: not finding.serious)


def _add(by_key: dict[str, Finding], more: Iterable[Finding]) -> None:
    """Add findings whose keys have none yet."""
    for finding in more:
        by_key.setdefault(finding.key, finding)


def _check_place(spec: SceneSpec, measured: Measured) -> Iterator[Finding]:
    """Scenes far from the origin; cameras and boxes far from the scene, or larger than it."""
    size = float(np.linalg.norm(measured.high - measured.low))
    away = float(np.linalg.norm(measured.high + measured.low)) / 2
    if away > FAR * size:
        yield Finding(
            "scene.file",
            f"the scene is {size:.3g} across and {away:.4g} away from the origin, where coordinates are so rough that "
            f"light leaks; `photonfarm scene import {spec.scene.file}` makes a copy near the origin",
        )
    for name, box in (("origin", spec.view.origin), ("look_at", spec.view.look_at)):
        apart = np.maximum(np.maximum(measured.low - box.high, box.low - measured.high), 0)
        off = float(np.linalg.norm(apart))
        if off > size:
            yield Finding(f"view.{name}", f"{name} is {off:.3g} away from the scene, which is {size:.3g} across")
    for index, group in enumerate(spec.groups):
        across = float(np.linalg.norm(group.box.high - group.box.low))
        if across > 1.5 * size:
            times = f"{across / size:.3g} times"
            sentence = f"box of {group.name!r} is {across:.3g} across, {times} as large as the whole scene ({size:.3g})"
            yield Finding(f"{group_key(spec, index)}.box", sentence)


def _check_cameras(spec: SceneSpec, cameras: Cameras) -> Iterator[Finding]:
    if cameras.nothing.mean() >= EMPTY:
        yield Finding("view.look_at", f"{format_share(cameras.nothing.mean())} of the cameras see no surface at all")
    if cameras.behind.mean() >= BEHIND:
        yield Finding(
            "view.origin",
            f"{format_share(cameras.behind.mean())} of the cameras stand outside the room, with a wall between them "
            "and what they look at; make origin smaller, or keep them out by `photonfarm scene free-space SPEC "
            "--write`",
        )
    elif cameras.inside_share >= INSIDE:
        most = " and ".join(repr(name) for name, _ in cameras.holders()[:2])
        yield Finding(
            "view.origin",
            f"{format_share(cameras.inside_share)} of the cameras stand inside objects, most of them inside {most}; "
            "keep origin away from furniture, or cameras out of it by `photonfarm scene free-space SPEC --write`",
        )
    elif cameras.near.mean() >= NEAR:
        yield Finding(
            "view.origin",
            f"{format_share(cameras.near.mean())} of the views show little but a surface within a hand "
            f"({hand_of(spec):.2g}); `photonfarm scene free-space SPEC --write` keeps cameras away from surfaces",
            serious=False,
        )
    well = cameras.placed_well
    if not well.any():
        return
    little = float(np.mean(cameras.seen[well] < LEAST_SEEN))
    if little >= SEES_LITTLE:
        yield Finding(
            "view",
            f"{format_share(little)} of the views see fewer than {max(1, round(LEAST_SEEN * spec.points))} of the "
            f"{spec.points} points, as they look at a wall from close by, or past the scene",
            serious=False,
        )
    if cameras.dark[well].mean() >= BLACK_BACKS:
        yield Finding(
            "scene.file",
            f"{format_share(cameras.dark[well].mean())} of what the cameras see are backs of one-sided materials, "
            'which are black; put <bsdf type="twosided"> around them in the scene file, if cameras may see them',
        )


def _check_brightness(spec: SceneSpec, samples: Samples) -> Iterator[Finding]:
    if not samples.images.halves.any():
        yield Finding("scene", f"all {len(samples.shown)} rendered views are black: no light reaches what they show")
        return
    mean = float(samples.images.display_means(spec.exposure).mean())
    if MEANS[0] <= mean <= MEANS[1]:
        return
    better = samples.images.find_exposure(TARGET)
    remedy = "too much is black for any exposure" if better is None else f"{better:.2g} would give {TARGET:g}"
    yield Finding(
        "exposure",
        f"exposure = {spec.exposure:g} makes pictures {'dark' if mean < MEANS[0] else 'bright'}, with a display mean "
        f"of {mean:.2f}; {remedy}",
    )


def _check_group(spec: SceneSpec, group: Movable, placed: Placed, key: str) -> Iterator[Finding]:
    size = float(np.linalg.norm(placed.high - placed.low))
    at = np.array(group.at)
    off = float(np.linalg.norm(np.maximum(np.maximum(placed.low - at, at - placed.high), 0)))
    if off > 0.5 * size and not group.stays:
        yield Finding(
            f"{key}.at",
            f"at of {group.name!r} is {off:.3g} away from its shapes, which are {size:.3g} across and stand at "
            f"{_point(placed.low)} … {_point(placed.high)}",
        )
    elif placed.outside >= OUTSIDE:
        yield Finding(
            f"{key}.box",
            f"box of {group.name!r} lets it leave the room, or stand in what does not move, in "
            f"{format_share(placed.outside)} of its places; make it smaller",
        )
    elif placed.cut >= CUT_AT_ALL:
        yield Finding(
            f"{key}.box",
            f"in {format_share(placed.cut)} of its places {group.name!r} overlaps what does not move, such as "
            f"{placed.through!r}: at {_point(placed.place)} {format_share(placed.worst)} of its surface is inside",
            serious=placed.cut >= CUT,
        )
    up = int(np.abs(spec.view.up).argmax())
    raised = (group.box.min[up] - group.at[up]) * np.sign(spec.view.up[up])
    if group in spec.objects and raised > max(0.1 * size, 1e-6):
        yield Finding(
            f"{key}.box.min", f"box of {group.name!r} raises it by at least {raised:.3g}, so that it floats", False
        )


def _point(point: Sequence[float] | F32) -> str:
    return f"[{', '.join(f'{value:.3g}' for value in point)}]"
