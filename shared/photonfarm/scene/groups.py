"""What may move in a scene, and how: groups of shapes, and lights that change what they emit.

Lengths are in scene units, angles in degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from photonfarm.core.formatting import format_count
from photonfarm.core.models import Factor, Frozen, Name, Positive, Probability

Vector = tuple[float, float, float]


class Box(Frozen):
    """An axis-aligned box; it may be flat in any axis."""

    min: Vector
    max: Vector

    @model_validator(mode="after")
    def _is_not_inverted(self) -> Self:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if low > high:
                raise ValueError(f"is inverted along {axis}: min {low} is above max {high}; min ≤ max is required")
        return self

    @property
    def low(self) -> NDArray[np.float64]:
        """The lower corner, (3,)."""
        return np.array(self.min)

    @property
    def high(self) -> NDArray[np.float64]:
        """The upper corner, (3,)."""
        return np.array(self.max)


class Range(Frozen):
    """The numbers from `min` to `max`; they may be one and the same."""

    min: float
    max: float

    @model_validator(mode="after")
    def _is_not_inverted(self) -> Self:
        if self.min > self.max:
            raise ValueError(f"is inverted: min {self.min} is above max {self.max}; min ≤ max is required")
        return self


Degrees = Annotated[float, Field(ge=1, le=170)]
"""A camera's field of view along the image's width."""


class Fov(Range):
    """Fields of view in degrees, along the image's width."""

    min: Degrees
    max: Degrees


class Turn(Range):
    """Angles in degrees, about the up axis: counter-clockwise as seen from above."""

    min: Annotated[float, Field(ge=-360, le=360)]
    max: Annotated[float, Field(ge=-360, le=360)]


class Power(Range):
    """Factors on what a light emits; 0 is dark."""

    min: Factor
    max: Factor


class Movable(Frozen):
    """Shapes that move and vanish as one: `at` is a fixed point of them, placed uniformly in `box`."""

    name: Name
    shapes: tuple[str, ...] = Field(min_length=1)
    at: Vector  # where the reference point stands in the scene as modelled
    box: Box  # where the reference point may stand
    removal_probability: Probability = 0.2
    turn: Turn | None = Field(default=None, exclude_if=lambda said: said is None)  # about `at`; then left out of ids

    @property
    def changes(self) -> str:
        """What changes of it beside its place, in words; empty where nothing does."""
        return f"turns {self.turn.min:g}…{self.turn.max:g}°" if self.turn else ""

    @property
    def stays(self) -> bool:
        """Whether it neither moves nor turns, and changes only what it emits."""
        return False


class Rectangle(Frozen):
    """A rectangular ceiling light that the spec adds to the scene, facing down the world's up axis."""

    size: tuple[Positive, Positive]  # along the two horizontal axes, in their order
    radiance: tuple[float, float, float]

    @model_validator(mode="after")
    def _emits(self) -> Self:
        if min(self.radiance) < 0 or max(self.radiance) == 0:
            raise ValueError(f"has radiance {self.radiance}; all ≥ 0 and one > 0 are required")
        return self


ORIGIN: Vector = (0.0, 0.0, 0.0)


class Light(Movable):
    """A movable light: emitting shapes of the scene, or a rectangle that the spec adds.

    Without `at` and `box` it stays where it is, and only what it emits changes; then it may also be a light without a
    shape, such as the sky.
    """

    shapes: tuple[str, ...] = ()
    at: Vector = ORIGIN
    box: Box = Box(min=ORIGIN, max=ORIGIN)
    rectangle: Rectangle | None = None
    removal_probability: Probability = 0.0
    power: Power | None = Field(default=None, exclude_if=lambda said: said is None)  # both then left out of ids
    colour: tuple[Vector, ...] = Field(default=(), exclude_if=lambda said: not said)  # factors on R, G, B: one of these

    @model_validator(mode="after")
    def _is_one_or_the_other(self) -> Self:
        if bool(self.shapes) == (self.rectangle is not None):
            raise ValueError("needs either shapes (of the scene) or a rectangle (to add), and not both")
        return self

    @model_validator(mode="after")
    def _stands_somewhere(self) -> Self:
        lacks = sorted({"at", "box"} - self.model_fields_set)
        stays = self.shapes and (self.power or self.colour) and not self.turn
        if lacks and not (len(lacks) == 2 and stays):
            raise ValueError(
                f"lacks {lacks[0]}; at and box are required, except of a light of the scene that stays where it is and "
                "has a power or colours"
            )
        return self

    @model_validator(mode="after")
    def _colours_emit(self) -> Self:
        for colour in self.colour:
            if min(colour) < 0 or max(colour) == 0:
                raise ValueError(f"has the colour {list(colour)}; all ≥ 0 and one > 0 are required")
        return self

    @property
    def changes(self) -> str:
        """What changes of it beside its place, in words; empty where nothing does."""
        power = f"power × {self.power.min:g}…{self.power.max:g}" if self.power else ""
        colours = format_count(len(self.colour), "colour") if self.colour else ""
        return ", ".join(filter(None, (super().changes, power, colours)))

    @property
    def stays(self) -> bool:
        """Whether it neither moves nor turns, and changes only what it emits."""
        moves = self.turn is not None or not self.box.min == self.box.max == self.at
        return not moves and bool(self.power or self.colour)

    @property
    def shape_ids(self) -> tuple[str, ...]:
        """The ids of its shapes in the loaded scene."""
        return self.shapes or (self.name,)


def names_of_ids(groups: Sequence[Movable]) -> list[str]:
    """The names of what an image of groups shows, by the numbers there, from 0 on: "" is what never moves."""
    return ["", *(group.name for group in groups)]


def shape_ids(group: Movable) -> tuple[str, ...]:
    """The ids of a group's shapes in the loaded scene."""
    return group.shape_ids if isinstance(group, Light) else group.shapes
