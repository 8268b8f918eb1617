"""What is held out of training: whole configurations (in a static scene, views), by a hash of their content."""

from __future__ import annotations

from collections.abc import Iterable

from photonfarm.shared.core.keys import Key, encoded, key_of


def are_held_out(units: Iterable[Key], share: float) -> list[bool]:
    """Whether the configurations (in a static scene, views) with these keys are held out of training.

    They are if the first 8 bytes of the content key ("hold out", unit) are below the share.
    """
    begin, limit = encoded("hold out"), share * 2.0**64
    return [int.from_bytes(key_of(begin + encoded(unit))[:8], "little") < limit for unit in units]
