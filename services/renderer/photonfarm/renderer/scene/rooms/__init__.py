"""The built-in rooms, made in code: no files, and nothing to download."""

from __future__ import annotations

from typing import Any


def describe(name: str) -> dict[str, Any]:
    """The shapes of a built-in room by id, for `mi.load_dict`; Mitsuba must be loaded."""
    from photonfarm.renderer.scene.rooms import room

    return room.describe_cornell() if name == "cornell" else room.describe_room()
