"""What a spec says that can hardly be meant, as far as its numbers and its scene file show it without Mitsuba.

`photonfarm scene check` finds what needs the scene itself.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from photonfarm.scene.groups import Box
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import NamedSpec, SpecLines

USUAL_FOV = (10.0, 130.0)
"""Fields of view between which nothing is said, in degrees."""

FAR_OFF = 20.0
"""A camera is far off at so many times the size of all that it may look at and move in."""

TOO_LARGE = 5.0
"""A box is too large at so many times the size of the box around all cameras and look-at points."""


Doubt = tuple[str, str]
"""One thing that can hardly be meant: its key, as `objects.1.box`, and what is said there and what follows from it."""


def warnings(named: NamedSpec) -> list[str]:
    """The doubts about a spec, each as one sentence after the line of its file; and that its free space is not known.

    The built-in rooms are known to have cameras in the open nearly everywhere.
    """
    lines, found = SpecLines.of(named.file), doubts(named.spec, named.lights)
    if named.spec.view.free_space is None and named.spec.scene.file is not None:
        keep_out = "`photonfarm scene free-space SPEC --write` keeps them out"
        found.append(("view.origin", f"cameras may stand inside furniture, where images are black; {keep_out}"))
    return [f"{lines.place(key)}: {sentence}" for key, sentence in found]


def doubts(spec: SceneSpec, lights: frozenset[str]) -> list[Doubt]:
    """What a spec says that can hardly be meant; `lights` are the ids of the scene's own lights."""
    return [*_check_view(spec), *_check_light(spec, lights), *_check_groups(spec)]


def group_key(spec: SceneSpec, index: int) -> str:
    """The key of a movable group by its number among all groups: `objects.0`, …, `lights.0`, …."""
    objects = len(spec.objects)
    return f"objects.{index}" if index < objects else f"lights.{index - objects}"


def _check_view(spec: SceneSpec) -> Iterator[Doubt]:
    view, (narrow, wide) = spec.view, USUAL_FOV
    usual = "40 to 90 degrees are usual in rooms"
    key, least, most = ("fov", view.fov.min, view.fov.max) if view.fov else ("fov_deg", view.fov_deg, view.fov_deg)
    if least < narrow:
        yield f"view.{key}", f"{key} = {least:g} shows as little as a telescope does; {usual}"
    if most > wide:
        yield f"view.{key}", f"{key} = {most:g} stretches what is near the image's edges; {usual}"
    gap = _gap(view.origin, view.look_at)
    places = [group.at for group in spec.groups if not group.stays]
    spread = float(np.linalg.norm(np.ptp(places, axis=0))) if places else 0.0
    scale = max(_size(view.origin), _size(view.look_at), spread)
    if gap >= view.far:
        away = f"which is {gap:.3g} away from origin: nothing there is seen"
        yield "view.far", f"far = {view.far:g} ends before look_at, {away}"
    elif scale and gap > FAR_OFF * scale:
        times = f"{gap / scale:.0f} times the size of all that is looked at"
        yield "view.origin", f"origin is {gap:.3g} away from look_at, {times}"
    if view.near > 0.1 * max(_size(_join(view.origin, view.look_at)), gap):
        yield "view.near", f"near = {view.near:g} hides everything nearer than that, which is much of the view"


def _check_light(spec: SceneSpec, lights: frozenset[str]) -> Iterator[Doubt]:
    follows = {
        0: "renders black images, as every path of light has at least one edge",
        1: "shows lights that are seen directly, and nothing that they light",
    }
    depth = spec.transport.max_depth
    if depth in follows:
        yield "transport.max_depth", f"max_depth = {depth} {follows[depth]}; 8 is usual"
    own = lights - {shape for light in spec.lights for shape in light.shape_ids}
    if all(light.removal_probability == 1 for light in spec.lights) and not any(map(spec.emitters.factor, own)):
        if own:
            yield "emitters", "emitters switches off every light of the scene, and nothing else shines: it is black"
        else:
            yield "scene", "the scene has no light at all, so that every image is black; add one under [[lights]]"


def _check_groups(spec: SceneSpec) -> Iterator[Doubt]:
    seen = _size(_join(spec.view.origin, spec.view.look_at))
    for index, group in enumerate(spec.groups):
        key = group_key(spec, index)
        size, off = _size(group.box), _gap(Box(min=group.at, max=group.at), group.box)
        if size > TOO_LARGE * seen:
            times = f"{size / seen:.0f} times as much as all cameras and look-at points ({seen:.3g})"
            yield f"{key}.box", f"box of {group.name!r} is {size:.3g} across, {times}"
        elif off > seen:
            yield (
                f"{key}.at",
                f"at of {group.name!r} is {off:.3g} away from its box, farther than the cameras' and look-at points' "
                f"box is across ({seen:.3g}): each placement moves it by that much",
            )
        if group.removal_probability == 1:
            yield f"{key}.removal_probability", f"removal_probability = 1: {group.name!r} is never there"


def _join(one: Box, other: Box) -> Box:
    low, high = np.minimum(one.low, other.low), np.maximum(one.high, other.high)
    return Box(min=tuple(low.tolist()), max=tuple(high.tolist()))


def _size(box: Box) -> float:
    return float(np.linalg.norm(box.high - box.low))


def _gap(one: Box, other: Box) -> float:
    """The distance between two boxes; 0 if they meet."""
    apart = np.maximum(np.maximum(one.low - other.high, other.low - one.high), 0)
    return float(np.linalg.norm(apart))
