"""What the renderer's tests share: one thread, as a worker has, and scenes that are small or made from a few lines."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec, parse_spec
from photonfarm.scene.view import View

# Modules bind Mitsuba's types on import. Equal seeds give equal bytes with one thread only: light splats are then added
# in a fixed order.
backend.load(threads=1)


@pytest.fixture(scope="session")
def small() -> Callable[..., SceneSpec]:
    """Function (spec, width, height, half_spp) → the spec with so small a film."""

    def shrink(spec: SceneSpec, width: int = 24, height: int = 16, half_spp: int = 2) -> SceneSpec:
        film = spec.film.model_copy(update={"width": width, "height": height})
        transport = spec.transport.model_copy(update={"half_spp": half_spp})
        return spec.model_copy(update={"film": film, "transport": transport})

    return shrink


@pytest.fixture(scope="module")
def room(small: Callable[..., SceneSpec]) -> LoadedScene:
    """The built-in room, in whatever state the test before left it."""
    return LoadedScene.load(small(load_spec("room")))


@pytest.fixture(scope="session")
def somewhere() -> View:
    """A view of the built-in room."""
    return View(np.array([1.9, 1.6, 1.7], np.float32), np.array([-0.7, 0.6, -0.5], np.float32))


GROUND = '<shape type="rectangle" id="Ground"><transform name="to_world"><rotate x="1" angle="-90"/>'
GROUND += '<scale value="4"/></transform></shape>'


@pytest.fixture(scope="session")
def file_scene() -> Callable[..., LoadedScene]:
    """Function (folder, XML, changes of the spec) → scene.xml written there, a ground below the XML, and loaded."""

    def write_and_load(folder: Path, content: str, **changes: Any) -> LoadedScene:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "scene.xml").write_text(f'<scene version="3.0.0">{GROUND}{content}</scene>')
        everywhere = {"min": [-4, 0, -4], "max": [4, 3, 4]}
        described = {
            "name": "edited",
            "scene": {"file": "scene.xml"},
            "view": {"origin": everywhere, "look_at": everywhere, "fov_deg": 70},
            "film": {"width": 16, "height": 16},
            "transport": {"max_depth": 4, "half_spp": 64},
            "points": 64,
            **changes,
        }
        return LoadedScene.load(parse_spec(described, where="test", beside=folder), folder)

    return write_and_load
