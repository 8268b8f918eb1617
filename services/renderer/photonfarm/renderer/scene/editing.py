"""Movable groups edited in place: nothing is added, removed or compiled again once the scene is loaded.

A removed group is *parked*: its shapes are shrunk to 10⁻⁴ of their size into the lower corner of the static geometry's
bounding box, and its lights shine with radiance 0, which `bdpt` and its photon tracer never select. So counts, types
and order of everything stay, and with them the compiled kernels. In the room `room` the corner lies outside the walls;
in a scene that is open there, a parked group keeps 10⁻⁸ of its area and does not shine.

Positions are always computed from those at rest, so that no rounding adds up: at rest they are bit by bit as loaded.

Groups turn about their `at`, and lights change what they emit, in the same way: vertices, transforms and radiances are
computed from those at rest.

The scene's own lights are dimmed or switched off by the factors that a spec has under `[emitters]`.
"""

from __future__ import annotations

from dataclasses import dataclass
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
from photonfarm.scene.groups import Light, Movable, shape_ids
from photonfarm.scene.modification import turn_about, turn_matrix
from photonfarm.scene.spec import SceneSpec

PARKED_SCALE = 1e-4

Parking = NDArray[np.float32]
"""The point (3,) that parked shapes are shrunk to."""


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """The rotation of a group about an axis through its `at`."""

    degrees: float
    up: NDArray[np.float64]  # (3,)
    at: NDArray[np.float64]  # (3,)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The rotation as an affine map, (4, 4)."""
        turned = np.eye(4)
        turned[:3, :3] = turn_matrix(self.degrees, self.up)
        return _shift(self.at) @ turned @ _shift(-self.at)


class MeshPlacement:
    """Places a mesh: its vertices move, its normals stay as modelled or turn with it."""

    def __init__(self, shape: Any) -> None:
        self._parameters = mi.traverse(shape)
        self._rest: F32 = np.array(self._parameters["vertex_positions"], np.float32).reshape(-1, 3)
        has_normals = shape.has_vertex_normals()
        self._normals = np.array(self._parameters["vertex_normals"], np.float32) if has_normals else None

    def move(self, translation: F32, turned: Turned | None = None) -> None:
        """Place the shape at `translation` (3,) from rest, `turned` before."""
        if turned is None:
            self._put(self._rest + translation, self._normals)
            return
        how, normals = (turned.degrees, turned.up), self._normals
        if normals is not None:
            normals = turn_about(normals.reshape(-1, 3), *how)
        self._put(turn_about(self._rest, *how, turned.at) + translation, normals)

    def park(self, parking: Parking) -> None:
        """Shrink the shape into the parking place."""
        self._put(parking + np.float32(PARKED_SCALE) * (self._rest - self._rest.min(axis=0)), self._normals)

    def _put(self, vertices: F32, normals: F32 | None) -> None:
        self._parameters["vertex_positions"] = floats(vertices)
        if normals is not None:  # in the same update: alone, new positions make Mitsuba compute others from faces
            self._parameters["vertex_normals"] = floats(normals)
        self._parameters.update()


class TransformPlacement:
    """Places a rectangle, sphere, disk or cylinder by its transform, which is opaque to the compiler."""

    def __init__(self, shape: Any) -> None:
        self._parameters = mi.traverse(shape)
        self._rest: NDArray[np.float64] = np.array(self._parameters["to_world"].matrix, np.float64).reshape(4, 4)
        self._corner = np.array([shape.bbox().min[i] for i in range(3)], np.float64)
        self.move(np.zeros(3, np.float32))

    def move(self, translation: F32, turned: Turned | None = None) -> None:
        """Place the shape at `translation` (3,) from rest, `turned` before."""
        at_rest = self._rest if turned is None else turned.matrix @ self._rest
        put_transform(self._parameters, _shift(translation.astype(np.float64)) @ at_rest)

    def park(self, parking: Parking) -> None:
        """Shrink the shape into the parking place."""
        shrunk = np.diag([PARKED_SCALE] * 3 + [1.0])
        to_world = _shift(parking.astype(np.float64)) @ shrunk @ _shift(-self._corner) @ self._rest
        put_transform(self._parameters, to_world)


DARK = np.zeros(3, np.float32)
LIT = np.ones(3, np.float32)
"""The factors of lights that are switched off, and of those that emit as modelled."""


class LightSwitch:
    """What one light emits: switched on and off, dimmed and coloured."""

    def __init__(self, emitter: Any, what: str, power: bool, colour: bool) -> None:
        """Take a light, and whether its power and its colour are to change; SpecError where they cannot."""
        self._parameters, self._what, self._kind = mi.traverse(emitter), what, emitter.class_name()
        self._power, self._colour = _dimmed_by(self._parameters), _coloured_by(self._parameters)
        changed = dict.fromkeys([*self._power, *(self._colour if colour else ())])
        values = {key: self._parameters[key] for key in changed}
        self._lit = {key: type(value)(value) for key, value in values.items()}  # references change with the scene
        if power:
            self.check(0.5 * LIT)
        if colour:
            self.check(np.array([1, 0.5, 0.25], np.float32))

    def check(self, light: F32) -> None:
        """Raise SpecError for factors on red, green and blue, (3,), that the light cannot have."""
        is_grey = (light == light[0]).all()
        if is_grey and light[0] in (0, 1):
            return
        can_colour = bool(self._colour) and all(_holds_colour(self._lit.get(key)) for key in self._colour)
        if is_grey:
            for key in self._power:
                _check_factor(key, self._lit[key], float(light[0]), self._what)
        if not (self._power if is_grey else can_colour):
            is_told = all(key in self._lit for key in self._colour)  # texels are kept where the spec has colours
            remedy = "give it an rgb radiance" if is_grey or is_told else "list its colours in the spec"
            changed = "power" if is_grey else "colour"
            raise SpecError(f"{self._what} cannot change its {changed}, as it is a {self._kind}; {remedy}")

    def shine(self, light: F32) -> None:
        """Multiply the red, green and blue that the light emits as modelled by `light`, (3,)."""
        power = light.max()
        colour = light / power if power else LIT
        for key, value in self._lit.items():
            of_power = light if key in self._colour else power * LIT
            self._parameters[key] = _scaled(value, of_power if key in self._power else colour)
            dr.make_opaque(self._parameters[key])
        self._parameters.update()


def _dimmed_by(parameters: Any) -> list[str]:
    """The names of a light's parameters that scale all that it emits."""
    return ["scale"] if "scale" in parameters else brightness_of(parameters)


def _coloured_by(parameters: Any) -> list[str]:
    """The names of a light's parameters that hold its colours."""
    return [*brightness_of(parameters), *(["data"] if "data" in parameters else [])]


def _holds_colour(value: Any) -> bool:
    """Whether a parameter holds red, green and blue as floats."""
    return dr.is_array_v(value) and dr.is_float_v(value) and dr.shape(value)[-1 if dr.is_tensor_v(value) else 0] == 3


def _scaled(value: Any, factors: F32) -> Any:
    """A parameter times factors on red, green and blue, which are one factor where it has no colours."""
    if (factors == 1).all():
        return type(value)(value)
    if not factors.any():
        return zeros_like(value)
    if dr.is_tensor_v(value):
        used = factors if _holds_colour(value) else factors[:1]
        return value * mi.TensorXf(floats(used), (len(used),))
    opaque = [dr.opaque(mi.Float, float(factor)) for factor in factors]  # literals would be compiled anew
    return value * (type(value)(*opaque) if _holds_colour(value) else opaque[0])


def _shift(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    shift = np.eye(4)
    shift[:3, 3] = offset
    return shift


class MovableGroup:
    """The shapes of one movable group, and its light without a shape."""

    def __init__(self, scene: Any, group: Movable, spec: SceneSpec) -> None:
        """Take a group of a scene, placed as modelled; SpecError for a light that cannot change as the spec has it."""
        self._at, self._up = np.array(group.at), np.array(spec.view.up, np.float64)
        shapes, emitters = _find_parts(scene, shape_ids(group), group.name)
        changes = isinstance(group, Light) and group.power is not None, isinstance(group, Light) and bool(group.colour)
        what = f"{spec.name}: light {group.name!r}"
        self._lights = [LightSwitch(emitter, what, *changes) for emitter in emitters]
        self._placements = [
            MeshPlacement(shape) if "vertex_positions" in mi.traverse(shape) else TransformPlacement(shape)
            for shape in shapes
        ]

    def move(self, translation: F32, degrees: float = 0) -> None:
        """Place the group at `translation` (3,) from rest, turned by `degrees` before."""
        turned = Turned(degrees, self._up, self._at) if degrees else None
        for placement in self._placements:
            placement.move(translation, turned)

    def check(self, light: F32) -> None:
        """Raise SpecError for factors that a light of the group cannot have."""
        for each in self._lights:
            each.check(light)

    def shine(self, light: F32) -> None:
        """Multiply the red, green and blue that the group emits as modelled by `light`, (3,)."""
        for each in self._lights:
            each.shine(light)

    def park(self, parking: Parking) -> None:
        """Remove the group from the scene."""
        for placement in self._placements:
            placement.park(parking)
        self.shine(DARK)


def _find_parts(scene: Any, wanted: tuple[str, ...], name: str) -> tuple[list[Any], list[Any]]:
    """The shapes of these ids, and the lights: those of the shapes, and lights without a shape of these names."""
    shapes = {shape.id(): shape for shape in scene.shapes()}
    others = {_name(emitter): emitter for emitter in scene.emitters() if emitter.get_shape() is None}
    if missing := sorted({*wanted} - {*shapes} - {*others}):
        raise SpecError(f"{name}.shapes: {missing[0]!r} is not a shape of the loaded scene")
    own = [shapes[part] for part in wanted if part in shapes]
    lights = [shape.emitter() for shape in own if shape.is_emitter()]
    return own, [*lights, *(others[part] for part in wanted if part not in shapes)]


def dim(scene: Any, spec: SceneSpec) -> None:
    """Multiply what each light of a loaded scene emits by its factor; movable lights keep theirs.

    Raises SpecError for a light that cannot be dimmed in place.
    """
    for emitter in scene.emitters():
        factor = factor_of(emitter, spec)
        if factor != 1:
            _multiply(emitter, factor, f"{spec.name}: emitters: light {_name(emitter)!r}")


def factor_of(emitter: Any, spec: SceneSpec) -> float:
    """The factor that a spec gives to one of the scene's own lights; 1 of those under `[[lights]]`."""
    name = _name(emitter)
    return 1.0 if any(name in light.shape_ids for light in spec.lights) else spec.emitters.factor(name)


def _name(emitter: Any) -> str:
    """The name of a light in a spec: the id of its shape, or else `ENVIRONMENT` or its own id."""
    shape = emitter.get_shape()
    return str(shape.id() if shape is not None else ENVIRONMENT if emitter.is_environment() else emitter.id())


def _multiply(emitter: Any, factor: float, what: str) -> None:
    parameters = mi.traverse(emitter)
    keys = _dimmed_by(parameters)
    if not keys:
        raise SpecError(f"{what} is a {emitter.class_name()}, which has no factor; only 1 is allowed")
    for key in keys:
        value = parameters[key]
        _check_factor(key, value, factor, what)
        parameters[key] = value * factor if factor else zeros_like(value)
        dr.make_opaque(parameters[key])
    parameters.update()


def _check_factor(key: str, value: Any, factor: float, what: str) -> None:
    """Raise SpecError for a parameter that cannot be multiplied by a factor."""
    if not dr.is_array_v(value):
        raise SpecError(
            f"{what} has {key}, which is not in proportion to its radiance; give it an rgb radiance to dim it"
        )
    if factor and not dr.is_float_v(value):
        raise SpecError(
            f"{what} has {key} in 8 bits, which have no room for factors but 0 and 1; give its bitmap "
            '<string name="format" value="variant"/>'
        )
