"""The inputs of a predictor for a batch of samples: camera and buffers always, others only if it needs them.

Shape letters: B batch, P points, L of them that are lit, K photon slots, H W image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.store.format.schema import output_arrays

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

M = TypeVar("M")
T = TypeVar("T", bound="DataclassInstance")

Memory = Callable[..., Tensor]
"""A function that makes an empty tensor of a shape, after the batch's axis; `dtype=` unless it is float32."""


@dataclass(frozen=True, slots=True)
class Needs:
    """The inputs that a predictor, trained or not, reads beside camera and buffers."""

    points: bool = True
    photons: bool = False
    guides: bool = False
    kept: int | None = None  # one of so many pixels of half A is an input, in noisy colour; None: no colour


POINTS_ONLY = Needs()


@dataclass(frozen=True, slots=True, eq=False)
class PointInputs:
    """The point cloud of each sample's configuration."""

    position: Tensor  # (B, P, 3) world, scene units
    present: Tensor  # (B, P) bool; False: of a removed group
    seen: Tensor  # (B, P) bool; in this view, as rendered


@dataclass(frozen=True, slots=True, eq=False)
class PhotonInputs:
    """The photons of each sample's configuration, in the store's fixed number of slots."""

    position: Tensor  # (B, K, 3) world, scene units
    direction: Tensor  # (B, K, 3) unit, the way the light travels
    normal: Tensor  # (B, K, 3) unit
    power: Tensor  # (B, K, 3) flux over the number of paths emitted, as stored
    bounce: Tensor  # (B, K) float: surfaces met before; −1: an empty slot
    present: Tensor  # (B, K) bool; False: an empty slot
    seen: Tensor  # (B, K) bool; in this view, as rendered


@dataclass(frozen=True, slots=True, eq=False)
class NoisyColour:
    """The kept pixels of one half-estimate."""

    colour: Tensor  # (B, H, W, 3) linear radiance × exposure, zero where not kept
    kept: Tensor  # (B, H, W) bool


@dataclass(frozen=True, slots=True, eq=False)
class GuideInputs:
    """The guides of each view, as in `records.Guides`; radiance × exposure."""

    emission: Tensor  # (B, H, W, 3)
    direct: Tensor  # (B, H, W, 3)
    gloss: Tensor  # (B, H, W, 3)
    specular: Tensor  # (B, H, W, 3)
    roughness: Tensor  # (B, H, W)
    mean_depth: Tensor  # (B, H, W) scene units, along the forward axis
    mean_normal: Tensor  # (B, H, W, 3)
    throughput: Tensor  # (B, H, W, 3)
    beyond_albedo: Tensor  # (B, H, W, 3)
    beyond_normal: Tensor  # (B, H, W, 3)
    beyond_depth: Tensor  # (B, H, W) scene units, along the path
    point_light: Tensor  # (B, L, 3) irradiance × exposure of the first points

    @classmethod
    def empty(cls, memory: Memory, spec: SceneSpec) -> GuideInputs:
        """Unfilled guides."""
        shapes = {name: array.shape for name, array in output_arrays(spec).items()}
        return cls(**{f.name: memory(*shapes[f.name]) for f in fields(cls)})


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """The inputs of a predictor for a batch of samples; those it does not need are None."""

    world_to_camera: Tensor  # (B, 3, 4)
    depth: Tensor  # (B, H, W) along the forward axis, 0: nothing hit
    albedo: Tensor  # (B, H, W, 3)
    normal: Tensor  # (B, H, W, 3)
    points: PointInputs | None = None
    photons: PhotonInputs | None = None
    noisy: NoisyColour | None = None
    guides: GuideInputs | None = None

    @classmethod
    def empty(cls, memory: Memory, points: int, spec: SceneSpec, needs: Needs) -> Inputs:
        """Unfilled inputs, with `points` points if points are needed."""
        film, slots = (spec.film.height, spec.film.width), spec.photons.slots

        def flags(*shape: int) -> Tensor:
            return memory(*shape, dtype=torch.bool)

        inputs = cls(memory(3, 4), memory(*film), memory(*film, 3), memory(*film, 3))
        if needs.points:
            inputs = replace(inputs, points=PointInputs(memory(points, 3), flags(points), flags(points)))
        if needs.photons:
            vectors = memory(slots, 3), memory(slots, 3), memory(slots, 3), memory(slots, 3)
            inputs = replace(inputs, photons=PhotonInputs(*vectors, memory(slots), flags(slots), flags(slots)))
        if needs.guides:
            inputs = replace(inputs, guides=GuideInputs.empty(memory, spec))
        if needs.kept:
            inputs = replace(inputs, noisy=NoisyColour(memory(*film, 3), flags(*film)))
        return inputs


def given(member: M | None) -> M:
    """A member of the inputs that is needed; raises ValueError if it was not filled."""
    if member is None:
        raise ValueError("inputs: lack what the network needs; make them with the `Needs` of its architecture")
    return member


def map_tensors(change: Callable[..., Tensor], record: T, *others: T) -> T:
    """The record with `change` applied to each tensor, and to the matching ones of other records; None stays None."""

    def changed(values: list[Any]) -> Any:
        if isinstance(values[0], Tensor):
            return change(*values)
        return None if values[0] is None else map_tensors(change, *values)

    records = (record, *others)
    return replace(record, **{f.name: changed([getattr(r, f.name) for r in records]) for f in fields(record)})
