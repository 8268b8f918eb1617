"""Conversions between arrays of numpy and of Dr.Jit."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.records import F32

ALIGNMENT_BYTES = 64
"""The width of the widest vector register."""


def floats(values: NDArray[Any]) -> Any:
    """All values, in order, as mi.Float in Dr.Jit's own memory.

    Dr.Jit uses numpy's memory without a copy, compiles a kernel anew for each combination of inputs at unaligned
    addresses (numpy aligns to 16 bytes only), and `dr.freeze` does not notice when a mesh gets other such memory.
    """
    return _evaluate(mi.Float(_align(values, np.float32)) * dr.opaque(mi.Float, 1))


def integers(values: NDArray[Any]) -> Any:
    """All values, in order, as mi.UInt32 in Dr.Jit's own memory."""
    return _evaluate(mi.UInt32(_align(values, np.uint32)) * dr.opaque(mi.UInt32, 1))


def _evaluate(product: Any) -> Any:
    dr.eval(product)
    return product


def _align(values: NDArray[Any], dtype: type) -> NDArray[Any]:
    spare = ALIGNMENT_BYTES // 4
    memory: NDArray[Any] = np.empty(values.size + spare, dtype)
    start = -(memory.ctypes.data // 4) % spare
    part = memory[start : start + values.size]
    part[:] = values.ravel()
    return part


def points(values: NDArray[Any]) -> Any:
    """Rows (N, 3) as mi.Point3f."""
    return mi.Point3f(*(floats(values[:, i]) for i in range(3)))


def put_transform(parameters: Any, to_world: NDArray[np.float64]) -> None:
    """Give the `to_world` of Mitsuba's parameters a matrix (4, 4) whose entries are opaque to the compiler."""
    matrix = mi.Matrix4f(*(dr.opaque(mi.Float, float(entry)) for entry in to_world.ravel()))
    parameters["to_world"] = type(parameters["to_world"])(matrix)
    dr.make_opaque(parameters["to_world"])
    parameters.update()


def zeros_like(value: Any) -> Any:
    """A parameter of Mitsuba's, array, tensor or number, with all its entries 0."""
    return dr.zeros(type(value), dr.shape(value)) if dr.is_array_v(value) else type(value)(0)


def shape_numbers(scene: Any) -> NDArray[np.int64]:
    """The number of a shape in the scene's order, by its number in Dr.Jit's registry; −1 where that is of no shape."""
    registered = np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))
    numbers = np.full(registered.max() + 1, -1, np.int64)
    numbers[registered] = np.arange(len(registered))
    return numbers


def rows(values: Any, *shape: int) -> F32:
    """Vectors of Dr.Jit as rows of numpy, (*shape, 3)."""
    return np.ascontiguousarray(np.array(values, np.float32).T).reshape(*shape, 3)
