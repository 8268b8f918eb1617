"""Movable groups edited in place: nothing is added, removed or compiled again once the scene is loaded.

A removed group is *parked*: its shapes are shrunk to 10⁻⁴ of their size into the lower corner of the static geometry's
bounding box, and its lights shine with radiance 0, which `bdpt` and its photon tracer never select. So counts, types
and order of everything stay, and with them the compiled kernels. In the room `room` the corner lies outside the walls;
in a scene that is open there, a parked group keeps 10⁻⁸ of its area and does not shine.

Positions are always computed from those at rest, so that no rounding adds up: at rest they are bit by bit as loaded.

The scene's own lights are dimmed or switched off by the factors that a spec has under `[emitters]`.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.core.records import F32
from photonfarm.renderer.bdpt.lights.selection import brightness_of
from photonfarm.renderer.scene.arrays import floats, put_transform, zeros_like
from photonfarm.scene.files import ENVIRONMENT
from photonfarm.scene.spec import SceneSpec

PARKED_SCALE = 1e-4

Parking = NDArray[np.float32]
"""The point (3,) that parked shapes are shrunk to."""


class MeshPlacement:
    """Places a mesh: its vertices move, its normals stay as modelled."""

    def __init__(self, shape: Any) -> None:
        self._parameters = mi.traverse(shape)
        self._rest: F32 = np.array(self._parameters["vertex_positions"], np.float32).reshape(-1, 3)
        self._normals = np.array(self._parameters["vertex_normals"], np.float32) if shape.has_vertex_normals() else None

    def move(self, translation: F32) -> None:
        """Place the shape at `translation` (3,) from rest."""
        self._put(self._rest + translation)

    def park(self, parking: Parking) -> None:
        """Shrink the shape into the parking place."""
        self._put(parking + np.float32(PARKED_SCALE) * (self._rest - self._rest.min(axis=0)))

    def _put(self, vertices: F32) -> None:
        self._parameters["vertex_positions"] = floats(vertices)
        if self._normals is not None:  # in the same update: alone, new positions make Mitsuba compute others from faces
            self._parameters["vertex_normals"] = floats(self._normals)
        self._parameters.update()


class TransformPlacement:
    """Places a rectangle, sphere, disk or cylinder by its transform, which is opaque to the compiler."""

    def __init__(self, shape: Any) -> None:
        self._parameters = mi.traverse(shape)
        self._rest: NDArray[np.float64] = np.array(self._parameters["to_world"].matrix, np.float64).reshape(4, 4)
        self._corner = np.array([shape.bbox().min[i] for i in range(3)], np.float64)
        self.move(np.zeros(3, np.float32))

    def move(self, translation: F32) -> None:
        """Place the shape at `translation` (3,) from rest."""
        put_transform(self._parameters, _shift(translation.astype(np.float64)) @ self._rest)

    def park(self, parking: Parking) -> None:
        """Shrink the shape into the parking place."""
        shrunk = np.diag([PARKED_SCALE] * 3 + [1.0])
        to_world = _shift(parking.astype(np.float64)) @ shrunk @ _shift(-self._corner) @ self._rest
        put_transform(self._parameters, to_world)


class LightSwitch:
    """The radiance of one area light, switched on and off."""

    def __init__(self, emitter: Any) -> None:
        self._parameters = mi.traverse(emitter)
        values = {key: self._parameters[key] for key in brightness_of(self._parameters)}
        self._lit = {key: type(value)(value) for key, value in values.items()}  # references change with the scene
        self._dark = {key: zeros_like(value) for key, value in self._lit.items()}

    def switch(self, on: bool) -> None:
        """Give the light its radiance, or radiance 0."""
        for key, value in (self._lit if on else self._dark).items():
            self._parameters[key] = value
            dr.make_opaque(self._parameters[key])
        self._parameters.update()


def _shift(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    shift = np.eye(4)
    shift[:3, 3] = offset
    return shift


class MovableGroup:
    """The shapes of one movable group."""

    def __init__(self, shapes: list[Any]) -> None:
        """Take shapes, which are placed as modelled."""
        self._lights = [LightSwitch(shape.emitter()) for shape in shapes if shape.is_emitter()]
        self._placements = [
            MeshPlacement(shape) if "vertex_positions" in mi.traverse(shape) else TransformPlacement(shape)
            for shape in shapes
        ]

    def move(self, translation: F32, *, was_present: bool) -> None:
        """Place the group at `translation` (3,) from rest."""
        for placement in self._placements:
            placement.move(translation)
        if not was_present:
            for light in self._lights:
                light.switch(True)

    def park(self, parking: Parking) -> None:
        """Remove the group from the scene."""
        for placement in self._placements:
            placement.park(parking)
        for light in self._lights:
            light.switch(False)


def dim(scene: Any, spec: SceneSpec) -> None:
    """Multiply what each light of a loaded scene emits by its factor; movable lights keep theirs.

    Raises SpecError for a light that cannot be dimmed in place.
    """
    moved = {shape for light in spec.lights for shape in light.shape_ids}
    for emitter in scene.emitters():
        factor = factor_of(emitter, spec)
        if factor != 1 and _name(emitter) not in moved:
            _multiply(emitter, factor, f"{spec.name}: emitters: light {_name(emitter)!r}")


def factor_of(emitter: Any, spec: SceneSpec) -> float:
    """The factor that a spec gives to one of the scene's own lights."""
    return spec.emitters.factor(_name(emitter))


def _name(emitter: Any) -> str:
    """The name of a light in a spec: the id of its shape, or else `ENVIRONMENT` or its own id."""
    shape = emitter.get_shape()
    return str(shape.id() if shape is not None else ENVIRONMENT if emitter.is_environment() else emitter.id())


def _multiply(emitter: Any, factor: float, what: str) -> None:
    parameters = mi.traverse(emitter)
    keys = ["scale"] if "scale" in parameters else brightness_of(parameters)
    if not keys:
        raise SpecError(f"{what} is a {emitter.class_name()}, which has no factor; only 1 is allowed")
    for key in keys:
        value = parameters[key]
        if not dr.is_array_v(value):
            raise SpecError(
                f"{what} has {key}, which is not in proportion to its radiance; give it an rgb radiance to dim it"
            )
        if factor and not dr.is_float_v(value):
            raise SpecError(
                f"{what} has {key} in 8 bits, which have no room for factors but 0 and 1; give its bitmap "
                '<string name="format" value="variant"/>'
            )
        parameters[key] = value * factor if factor else zeros_like(value)
        dr.make_opaque(parameters[key])
    parameters.update()
