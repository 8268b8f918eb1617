"""The scenes of the benchmarks, by name: hard scenes, the built-in room, Mitsuba XML files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def load(name: str, size: int) -> Any:
    """The scene of this name, folder or path, seen on a film of size × size pixels.

    Raises ValueError if there is none.
    """
    import mitsuba as mi

    from photonfarm.renderer.scene.loading import threads_to_read_with

    loaders = scene_loaders()
    if name in loaders:
        return loaders[name](size)
    folder = Path(os.environ.get("PHOTONFARM_SCENES", "."))
    for path in (Path(name), folder / name / "scene.xml"):
        if path.is_file():
            with threads_to_read_with():
                return mi.load_file(str(path), optimize=False, resx=size, resy=size)
    raise ValueError(
        f"scene {name!r} is neither one of {sorted(loaders)}, nor a file, nor a folder with a scene.xml under "
        f"PHOTONFARM_SCENES ({folder})"
    )


def scene_loaders() -> dict[str, Callable[[int], Any]]:
    """Name → function of the image size that loads the scene. Other packages' scenes are added here."""
    import mitsuba as mi

    from tests.stability.scenes.hard_scenes import HARD_SCENES

    def loader(build: Callable[[int], Any]) -> Callable[[int], Any]:
        return lambda size: mi.load_dict(build(size), optimize=False)

    return {name: loader(build) for name, build in HARD_SCENES.items()} | {"room": loader(_room)}


def _room(size: int) -> dict[str, Any]:
    """The built-in room as modelled, seen from a corner."""
    import mitsuba as mi

    from photonfarm.renderer.scene import rooms

    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(origin=[2.3, 1.6, 1.9], target=[-0.8, 0.8, -0.8], up=[0, 1, 0])
    sensor = {"type": "perspective", "fov": 70, "near_clip": 0.05, "to_world": to_world, "film": film}
    return {"type": "scene", **rooms.describe("room"), "sensor": sensor}
