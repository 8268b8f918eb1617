"""What is held out of training: whole configurations (in a static scene, views), by a hash of their content."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal, Protocol, TypeVar

if TYPE_CHECKING:
    from photonfarm.core.keys import Key
    from photonfarm.scene.spec import SceneSpec

HOLD_OUT = 0.125
"""The share that is held out unless another one is named, by `photonfarm up` and by the trainer's preset `small`."""

Side = Literal["train", "held-out"] | None
"""Samples to train on, samples that measure the error, and those that are neither."""

Rows = TypeVar("Rows", contravariant=True)


class Keyed(Protocol[Rows]):
    """Anything with samples or views in rows, of which it knows the content keys."""

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec."""

    def modification_keys(self, rows: Rows) -> list[Key]:
        """The content key of each row's configuration."""

    def view_keys(self, rows: Rows) -> list[Key]:
        """The content key of each row's configuration and view."""

    def are_uniform(self, rows: Rows) -> list[bool]:
        """Whether each row's configuration and view were drawn uniformly from the spec."""


def units_of(source: Keyed[Rows], rows: Rows) -> list[Key]:
    """The unit by which each row is held out: the key of its configuration or, in a static scene, of its view."""
    return source.modification_keys(rows) if source.spec.groups else source.view_keys(rows)


def sides_of(source: Keyed[Rows], rows: Rows, share: float) -> list[Side]:
    """The side of each row, by its content and not by its time of arrival.

    All views and passes of a configuration are on one side. A static scene has one configuration; there the view
    decides, and all passes of a view are on one side. The held-out error is one over uniform draws from the spec; so a
    row that was chosen otherwise, or by a person, is never held out, and of a configuration that is, it is on no side.
    """
    held_out, uniform = are_held_out(units_of(source, rows), share), source.are_uniform(rows)
    return [
        ("held-out" if is_uniform else None) if is_out else "train"
        for is_out, is_uniform in zip(held_out, uniform, strict=True)
    ]


def rows_held_out(source: Keyed[Rows], rows: Rows, share: float) -> list[bool]:
    """Whether each row is held out of training; some of the others may be on no side, as `sides_of` says."""
    return [side == "held-out" for side in sides_of(source, rows, share)]


def are_held_out(units: Iterable[Key], share: float) -> list[bool]:
    """Whether the configurations (in a static scene, views) with these keys are held out of training.

    They are if their place is below the share of 2^64.
    """
    limit = share * 2.0**64
    return [place < limit for place in places_of(units)]


def places_of(units: Iterable[Key]) -> list[int]:
    """The place of each unit among all that there could be, from 0 to 2^64 − 1.

    They are the first 8 bytes of the content key ("hold out", unit).
    """
    from photonfarm.core.keys import make_key  # numpy is slow to load, and the constant needs none

    return [int.from_bytes(make_key("hold out", unit)[:8], "little") for unit in units]


def enough(units: Iterable[Key], least: float = HOLD_OUT) -> float | None:
    """A share, at least `least`, that holds out one of these units and leaves one; None if no share does.

    It is `least` itself where that does. Else it holds out as few as it can, and has as few digits as it can.
    """
    places = sorted(set(places_of(units)))
    if len(places) < 2:
        return None
    for digits in range(2, 18):
        share = max(least, math.ceil(places[0] / 2.0**64 * 10**digits) / 10**digits)
        if places[0] < share * 2.0**64 <= places[-1] and (share == least or share * 2.0**64 <= places[1]):
            return share
    return None
