"""Load a scene spec as a Mitsuba scene: the file or built-in room, with the lights that the spec adds.

The spec's film and camera become one Mitsuba sensor, which is aimed in place.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.renderer.bdpt.lights.selection import is_flat
from photonfarm.renderer.bdpt.scenes import check_scene
from photonfarm.renderer.scene import rooms
from photonfarm.renderer.scene.arrays import put_transform
from photonfarm.renderer.scene.editing import dim, factor_of
from photonfarm.renderer.scene.solids import rectangle_light
from photonfarm.scene.files import SceneFile
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import find_scene
from photonfarm.scene.view import Camera, View


class AimedSensor:
    """A perspective sensor whose transform is opaque to the compiler, so that views cost no compilation."""

    def __init__(self, spec: SceneSpec) -> None:
        """Have a float32 RGB film with a box filter, the field of view along the width, and the clip planes."""
        film = {
            "type": "hdrfilm",
            "width": spec.film.width,
            "height": spec.film.height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }
        self._described = {
            "type": "perspective",
            "fov": spec.view.fov_deg,
            "fov_axis": "x",
            "near_clip": spec.view.near,
            "far_clip": spec.view.far,
            "film": film,
            "sampler": {"type": "independent", "sample_count": spec.transport.half_spp},
        }
        self._spec, self._fov_deg = spec, spec.view.fov_deg
        self.sensor = mi.load_dict(self._described)
        self._parameters = mi.traverse(self.sensor)

    @cached_property
    def at_origin(self) -> Any:
        """A sensor that stays at the origin and looks along +z, for the integrator to place."""
        return mi.load_dict(self._described)

    def aim(self, view: View) -> Any:
        """The sensor, looking at this view."""
        if (fov_deg := float(view.fov or self._spec.view.fov_deg)) != self._fov_deg:
            self._parameters["x_fov"] = dr.opaque(mi.Float, fov_deg)
            self._fov_deg = fov_deg
        put_transform(self._parameters, _pose(Camera.of(view, self._spec)))
        return self.sensor

    def place(self, view: View) -> NDArray[np.float64]:
        """The camera-to-world matrix (4, 4) of a view for `at_origin`, as `Places` has it."""
        camera, usual = Camera.of(view, self._spec), Camera.of(replace(view, fov=None), self._spec)
        to_world = _pose(camera)
        to_world[:, :2] *= usual.focal_px / camera.focal_px
        return to_world


def _pose(camera: Camera) -> NDArray[np.float64]:
    """The camera-to-world matrix (4, 4) of a camera: Mitsuba's has +x to the left, +y up, +z ahead."""
    to_world = np.eye(4)
    to_world[:3] = np.stack([-camera.right, -camera.down, camera.forward, camera.origin], axis=1)
    return to_world


def load_scene(spec: SceneSpec, beside: Path | None = None) -> Any:
    """The Mitsuba scene of a spec; its cameras, films and integrators are ignored, as the spec has its own.

    Shapes stay separate (`optimize=False`), as merged ones could not move. Raises SpecError for a file that is missing,
    that changed since the spec was read, or that Mitsuba or the integrator refuses.
    """
    if spec.scene.file:
        scene = _load_file(spec, beside)
    else:
        shapes = rooms.describe(str(spec.scene.builtin))
        scene = mi.load_dict({"type": "scene", **shapes, **_describe_added_lights(spec)}, optimize=False)
        dim(scene, spec)
    try:
        check_scene(scene, light_paths=bool(spec.transport.light_ratio or spec.photons.paths))
    except ValueError as error:
        raise SpecError(f"{spec.name}: {error}") from error
    for shape in scene.shapes():  # only hits find mesh lights with smooth normals, which would give almost pure noise
        if shape.is_emitter() and shape.is_mesh() and not np.array(is_flat(shape)).all():
            raise SpecError(
                f"{spec.name}: mesh light {shape.id()!r} has smooth vertex normals, with which it cannot be sampled "
                'without bias; give it <boolean name="face_normals" value="true"/>'
            )
    return scene


def _load_file(spec: SceneSpec, beside: Path | None) -> Any:
    file = find_scene(str(spec.scene.file), spec.name, beside)
    if SceneFile.read(file).digest != spec.content:
        raise SpecError(
            f"{spec.name}: {file} or a file it names is not what the spec was made from; load the spec anew"
        )
    try:
        with threads_to_read_with():
            scene = mi.load_file(str(file), optimize=False, **spec.scene.parameters)
    except (RuntimeError, ValueError) as error:
        raise SpecError(f"{file}: Mitsuba cannot load it: {' '.join(str(error).split())}") from error
    dim(scene, spec)
    free = [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
    shining = [emitter for emitter in free if factor_of(emitter, spec) > 0]
    added = _describe_added_lights(spec)
    if len(shining) == len(free) and not added:
        return scene
    return scene_of([*scene.shapes(), *shining], added)


@contextmanager
def threads_to_read_with() -> Iterator[None]:
    """Use two threads at least: the decoder of OpenEXR files waits for ever in a pool of one."""
    count = dr.thread_count()
    dr.set_thread_count(max(count, 2))
    try:
        yield
    finally:
        dr.set_thread_count(count)


def scene_of(parts: list[Any], added: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """A scene of loaded parts, which keep their ids, and of added ones that are loaded here."""
    ids = [part.id() for part in parts]
    keys = [f"_part_{i}" for i in range(len(parts))]  # ids need not be there, and may have dots, which no key may
    scene = mi.load_dict({"type": "scene", **dict(zip(keys, parts, strict=True)), **added}, optimize=False)
    for part, name in zip(parts, ids, strict=True):
        part.set_id(name)
    return scene


def _describe_added_lights(spec: SceneSpec) -> dict[str, Any]:
    return {
        light.name: rectangle_light(light.at, light.rectangle.size, spec.view.up, light.rectangle.radiance)
        for light in spec.lights
        if light.rectangle is not None
    }
