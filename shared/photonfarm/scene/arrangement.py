"""Configurations and cameras as people say them: by the names of groups, and where each stands.

This module alone turns names into modification vectors, and back. The command line, the files of camera paths and
`photonfarm.predict` all give an `Arrangement`. What else may change of a group is one more field of it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, ValidationError
from pydantic_core import ErrorDetails

from photonfarm.core.errors import SpecError
from photonfarm.core.models import Factor, Frozen, nearest, rule_of, show_value
from photonfarm.scene.groups import Box, Degrees, Light, Movable
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View, are_in_free_space, are_in_group, field_of_view, sample_view

SLACK = 1e-4
"""How far beyond a box nothing is said, in scene units: float32 has no more digits."""


def _as_list(value: Any) -> Any:
    """Arrays of numpy's and of torch's as lists."""
    return value.tolist() if hasattr(value, "tolist") else value


Number = Annotated[float, Field(ge=-1e18, le=1e18)]
"""A number of which float32 holds the square, too."""

Point = Annotated[tuple[Number, Number, Number], BeforeValidator(_as_list)]


COLUMNS_OF = {
    "place": slice(0, 3),
    "move": slice(0, 3),
    "without": slice(0, 3),
    "turn": slice(4, 5),
    "power": slice(5, 6),
    "colour": slice(6, 9),
}
"""The columns of the modification vector that each field of an arrangement is about; column 3 says what is there."""

MOST_NAMES = 12
"""The most groups that are named where none is called nearly so."""

BESIDE_PLACE = ("turn", "power", "colour")
"""The fields beside where a group stands."""

GIVEN_BY = {
    "place": "at = [0, 0, 0] and box = { min = [-1, 0, -1], max = [1, 0, 1] }",
    "turn": "turn = { min = -45, max = 45 }",
    "power": "power = { min = 0.2, max = 2 }",
    "colour": "colour = [[1, 1, 1], [1, 0.8, 0.5]]",
}
"""What in a group's table of the spec lets each of its fields change."""


class Arrangement(Frozen):
    """What is changed of a configuration, by the names of groups; all others stay."""

    place: dict[str, Point] = Field(default_factory=dict)  # where a group's `at` shall stand, scene units
    move: dict[str, Point] = Field(default_factory=dict)  # by how much it goes from where it stands
    without: tuple[str, ...] = ()  # groups that are removed
    turn: dict[str, Number] = Field(default_factory=dict)  # from how it was modelled, degrees about the up axis
    power: dict[str, Factor] = Field(default_factory=dict)  # factor on what a light emits
    colour: dict[str, tuple[Factor, Factor, Factor]] = Field(default_factory=dict)  # further ones, on red, green, blue

    @classmethod
    def of(cls, /, **values: Any) -> Self:
        """The checked values; raises SpecError with a sentence for each that is impossible, as it was written."""
        try:
            return cls(**values)
        except ValidationError as error:
            said = dict.fromkeys(_describe_fault(fault, values, cls.model_fields) for fault in error.errors())
            raise SpecError("; ".join(said)) from error

    @classmethod
    def from_modification(cls, spec: SceneSpec, modification: Modification) -> Self:
        """What a configuration changes of the scene at rest."""
        found: dict[str, dict[str, Any]] = {key: {} for key in ("place", *BESIDE_PLACE)}
        without = []
        for group, now, before in zip(spec.groups, modification.vector, rest(spec).vector, strict=True):
            if not now[3]:
                without.append(group.name)
                continue
            if now[:3].any():
                found["place"][group.name] = tuple(map(_round_position, group.at, now[:3]))
            for key in BESIDE_PLACE:
                if (now[COLUMNS_OF[key]] != before[COLUMNS_OF[key]]).any():
                    value = _shorten(now[COLUMNS_OF[key]])
                    found[key][group.name] = value[0] if len(value) == 1 else tuple(value)
        return cls(**found, without=tuple(without))

    def apply(self, spec: SceneSpec, start: Modification | None = None) -> Modification:
        """The configuration that this makes of another one, by default of the scene at rest.

        A group that is named is there, even if it was removed, unless it is left out. Raises SpecError for a name that
        no group has, for what contradicts itself, and for a turn, power or colour of a group whose spec has none.
        """
        made = (rest(spec) if start is None else start).vector.copy()
        number = {group.name: g for g, group in enumerate(spec.groups)}
        for name, key in self._list_named():
            if name not in number:
                raise SpecError(f"{name!r} is no movable group of {spec.name}; {_suggest(name, number)}")
            keys = dict.fromkeys(other for named, other in self._list_named() if named == name)
            if (len(keys) > 1 and "without" in keys) or {"place", "move"} <= {*keys}:
                raise SpecError(f"{name!r}: {' and '.join(keys)} contradict each other; give one of them")
            g = number[name]
            if key == "without":  # at rest, so that equal configurations have equal keys
                made[g] = rest(spec).vector[g]
            elif key == "move":
                made[g, :3] += np.array(self.move[name], np.float32)
            elif key == "place":
                made[g, :3] = np.array(self.place[name]) - np.array(spec.groups[g].at)
            else:
                _check_changes(spec, name, key)
                made[g, COLUMNS_OF[key]] = getattr(self, key)[name]
            if spec.groups[g].stays and made[g, :3].any():
                _check_changes(spec, name, "place")
            made[g, 3] = key != "without"
        return Modification.from_vector(made)

    def fits(self, spec: SceneSpec, modifications: NDArray[np.float32]) -> NDArray[np.float64]:
        """How far configurations (N, G, C) are from this, by the farthest value that is named, (N,).

        It is infinite where a group is not there and should be, or the other way. Groups that are not named may be
        anywhere. Raises SpecError as `apply` does.
        """
        wanted, distance = self.apply(spec).vector, np.zeros(len(modifications))
        number = {group.name: g for g, group in enumerate(spec.groups)}
        for name, key in self._list_named():
            g = number[name]
            off = modifications[:, g, COLUMNS_OF[key]].astype(np.float64) - wanted[g, COLUMNS_OF[key]]
            fits = (modifications[:, g, 3] != 0) == (wanted[g, 3] != 0)
            distance = np.maximum(distance, np.where(fits, np.linalg.norm(off, axis=1), np.inf))
        return distance

    def describe(self) -> str:
        """The arrangement as options of the command line; "" if nothing is changed."""
        words = []
        for name, key in self._list_named():
            said = "" if key == "without" else f"={_text(np.atleast_1d(getattr(self, key)[name]))}"
            words.append(f"--{key} {name}{said}")
        return " ".join(words)

    def _list_named(self) -> Iterator[tuple[str, str]]:
        """The names, each with the field that it is in."""
        for key in COLUMNS_OF:
            yield from ((name, key) for name in getattr(self, key))


class Shot(Arrangement):
    """An arrangement, and the camera that looks at it."""

    camera: Point | None = None  # where it stands, scene units
    look_at: Point | None = None  # the point that it looks at
    fov: Degrees | None = Field(default=None, exclude_if=lambda said: said is None)  # along the image's width

    def view(self, spec: SceneSpec, start: View | None = None) -> View:
        """The view that this makes of another one, by default of the scene's first one at rest.

        A camera without a point to look at looks at the middle of the spec's box, and one without a field of view has
        the spec's `fov_deg`, unless there is a start. Raises SpecError for a camera that would look at itself.
        """
        view = start or sample_view(spec, rest(spec).key(spec.radiance_id), 0, 0)
        target = view.target
        if self.look_at is not None:
            target = np.array(self.look_at, np.float32)
        elif start is None and self.camera is not None:
            target = (0.5 * (spec.view.look_at.low + spec.view.look_at.high)).astype(np.float32)
        fov = self.fov
        if fov is None and view.fov is not None and (start is not None or self.camera is None):
            fov = float(view.fov)
        origin = view.origin if self.camera is None else np.array(self.camera, np.float32)
        made = View(origin, target, field_of_view(spec, fov))
        if np.array_equal(made.origin, made.target):
            raise SpecError(f"camera = {_text(_shorten(made.origin))}: is where it looks at; give another look_at")
        return made


def _describe_fault(fault: ErrorDetails, values: Mapping[str, Any], known: Iterable[str]) -> str:
    """What is wrong with a field of an arrangement: its key, the group, the value and the rule."""
    key, *inside = map(str, fault["loc"])
    if fault["type"] == "extra_forbidden":
        return f"{key}: unknown key; nearest: {nearest(key, known)}"
    value, of = values[key], ""
    if isinstance(value, Mapping) and inside:
        value, of = value.get(inside[0]), f" of {inside[0]!r}"
    rule = rule_of(fault)
    if fault["type"] in ("missing", "too_long") or (fault["type"] == "tuple_type" and key != "without"):
        rule = "three numbers are required"
    elif fault["type"] == "dict_type":
        rule = "values by the names of groups are required"
    return f"{key}{of} = {show_value(_as_list(value))}: {rule}"


def _suggest(name: str, known: Collection[str]) -> str:
    """What to write instead of a name that no group has: those close to it, or else the first groups of all."""
    if (near := nearest(name, known, least=0.6)) != "none":
        return f"nearest: {near}"
    few = [*known][:MOST_NAMES]
    more = f" and {len(known) - len(few)} more" if len(known) > len(few) else ""
    return f"its groups: {', '.join(few) or 'none'}{more}"


def _check_changes(spec: SceneSpec, name: str, key: str) -> None:
    """Raise SpecError, with what to add, if this cannot change of a group by its spec."""
    able = [each.name for each in spec.groups if (not each.stays if key == "place" else getattr(each, key, None))]
    if name not in able:
        where = "its table"
        if key in ("power", "colour"):
            is_object = any(each.name == name for each in spec.objects)
            where = "a table of [[lights]], if it shines," if is_object else "a light's table"
        raise SpecError(
            f"{key} of {name!r}: the spec of {spec.name} gives one to {', '.join(able) or 'no group'}; "
            f"{GIVEN_BY[key]} in {where} adds it, and makes another scene"
        )


def describe_shot(spec: SceneSpec, modification: Modification, view: View) -> str:
    """A configuration and a view as options of the command line."""
    stands = Arrangement.from_modification(spec, modification).describe()
    camera = f"--camera {_text(_shorten(view.origin))} --look-at {_text(_shorten(view.target))}"
    fov = "" if view.fov is None else f" --fov {float(str(view.fov)):.9g}"
    return f"{stands} {camera}{fov}".lstrip()


def list_shot(spec: SceneSpec, modification: Modification, view: View) -> dict[str, Any]:
    """A configuration and a view by names, for JSON."""
    stands = Arrangement.from_modification(spec, modification).model_dump(mode="json", exclude={"move"})
    fov = spec.view.fov_deg if view.fov is None else float(str(view.fov))
    return {**stands, "camera": _shorten(view.origin), "look_at": _shorten(view.target), "fov": fov}


def _shorten(point: NDArray[np.float32]) -> list[float]:
    """The numbers of fewest digits that are these in float32."""
    return [float(str(value)) for value in point]


def _round_position(at: float, moved: np.float32) -> float:
    """A position with as few digits as it can have, and still be so far from `at` in float32."""
    position = at + float(moved)
    rounded = (round(position, digits) + 0.0 for digits in range(3, 10))  # never −0
    return next((short for short in rounded if np.float32(short - at) == moved), position)


def _text(point: Any) -> str:
    return ",".join(f"{value:.9g}" for value in point)


def find_doubts(spec: SceneSpec, modification: Modification, view: View | None = None) -> list[str]:
    """What no sample of a spec shows: groups beyond their boxes, groups that are never removed, cameras elsewhere.

    Each is a sentence. The renderer's `look_closer` finds what needs the scene's surfaces.
    """
    doubts = []
    for group, now in zip(spec.groups, modification.vector, strict=True):
        if not now[3] and group.removal_probability == 0:
            doubts.append(f"{group.name} is removed, and in the spec it never is")
        elif now[3] and group.removal_probability == 1:
            doubts.append(f"{group.name} is there, and in the spec it never is")
        elif now[3]:  # also where it was modelled: that may be outside its box
            doubts += _find_beyond(group, now)
    if view is None:
        return doubts
    if view.fov is not None:
        low, high = (spec.view.fov.min, spec.view.fov.max) if spec.view.fov else (spec.view.fov_deg, spec.view.fov_deg)
        if not low - SLACK <= view.fov <= high + SLACK:
            usual = f"not {low:g}°" if low == high else f"outside {low:g}° to {high:g}°"
            doubts.append(f"the field of view is {view.fov:g}°, {usual}")
    for what, point, box in (
        ("the camera stands", view.origin, spec.view.origin),
        ("the camera looks", view.target, spec.view.look_at),
    ):
        if not _holds(box, point):
            doubts.append(f"{what} at {_text(_shorten(point))}, outside the spec's box {_span(box)}")
    obstacle = next(find_obstacles(spec, [view], modification), None)
    return doubts if obstacle is None else [*doubts, f"the camera stands {obstacle[1]}"]


def _find_beyond(group: Movable, now: NDArray[np.float32]) -> Iterator[str]:
    """What of a group that is there is beyond its spec."""
    position = tuple(map(_round_position, group.at, now[:3]))
    if not _holds(group.box, position):
        yield f"{group.name} stands at {_text(position)}, outside its box {_span(group.box)}"
    if len(now) > COLUMNS_OF["turn"].start:
        power, colours = (group.power, group.colour) if isinstance(group, Light) else (None, ())
        for what, value, usual, limits in (("turn", now[4], 0, group.turn), ("power", now[5], 1, power)):
            low, high = (limits.min, limits.max) if limits else (usual, usual)
            if not low - SLACK <= value <= high + SLACK:
                beyond = f"outside {low:g} to {high:g}" if limits else "and the spec gives it none"
                yield f"{what} of {group.name} is {value:g}, {beyond}"
        if not any(np.allclose(now[6:], colour) for colour in colours or [(1, 1, 1)]):
            yield f"colour of {group.name} is {_text(_shorten(now[6:]))}, which is none of its spec"


def _holds(box: Box, point: Any) -> bool:
    return bool(((np.array(point) >= box.low - SLACK) & (np.array(point) <= box.high + SLACK)).all())


def _span(box: Box) -> str:
    return f"from {_text(box.low)} to {_text(box.high)}"


def find_obstacles(spec: SceneSpec, views: list[View], modification: Modification) -> Iterator[tuple[int, str]]:
    """The views whose cameras are not in free space, by number, each with what they stand in; none is known without."""
    vectors = modification.vector[None].repeat(len(views), axis=0)
    origins = np.stack([view.origin for view in views])
    around = {group.name: are_in_group(spec, g, origins, vectors) for g, group in enumerate(spec.groups)}
    for number in np.flatnonzero(~are_in_free_space(spec, origins, vectors)).tolist():
        names = [name for name, holds in around.items() if holds[number]]
        yield number, f"in the box around {names[0]!r}" if names else "in a solid of the scene, or close to one"
