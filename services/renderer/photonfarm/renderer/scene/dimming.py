"""The scene's own lights dimmed or switched off: the factors that a spec has under `[emitters]`."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.bdpt.lights.selection import BRIGHTNESS
from photonfarm.renderer.scene.arrays import zeros_like
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.scene.files import ENVIRONMENT
from photonfarm.shared.scene.spec import SceneSpec


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
    names = list(parameters.keys())
    brightness = [name for name in names if name.startswith(BRIGHTNESS) and not name.endswith("to_uv")]
    keys = ["scale"] if "scale" in names else brightness
    if not keys:
        raise SpecError(f"{what} is a {emitter.class_name()}, which has no factor; only 1 is allowed")
    for key in keys:
        parameters[key] = _product(parameters[key], factor, f"{what} has {key}")
        dr.make_opaque(parameters[key])
    parameters.update()


def _product(value: Any, factor: float, what: str) -> Any:
    if not dr.is_array_v(value):
        raise SpecError(f"{what}, which is not in proportion to its radiance; give it an rgb radiance to dim it")
    if factor == 0:
        return zeros_like(value)
    if not dr.is_float_v(value):
        raise SpecError(
            f"{what} in 8 bits, which have no room for factors but 0 and 1; give its bitmap "
            '<string name="format" value="variant"/>'
        )
    return value * factor
