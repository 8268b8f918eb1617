"""The properties of a scene's materials that guides need; no edit changes them, so they are read once."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import Any, Self

import drjit as dr
import mitsuba as mi
import numpy as np

from photonfarm.core.records import F32

ROUGHNESS = frozenset({"alpha", "alpha_u", "alpha_v", "roughness"})
"""The names under which Mitsuba's materials state roughness."""


@dataclass(frozen=True, slots=True, eq=False)
class Materials:
    """The BSDFs of a scene's shapes."""

    roughness: F32  # microfacet α, by the number of a BSDF in Dr.Jit's registry
    diffuse_kept: F32  # by that number: see `_diffuse_kept`
    has_pure_deltas: bool  # some are of delta lobes alone, and so are followed
    has_other_lobes: bool  # some have lobes beside a diffuse one, and are not followed

    @classmethod
    def of(cls, scene: Any) -> Self:
        """The materials of a scene."""
        bsdfs = [shape.bsdf() for shape in scene.shapes() if shape.bsdf() is not None]
        numbers = [int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0]) for bsdf in bsdfs]
        roughness = np.ones(max(numbers, default=0) + 1, np.float32)
        kept = np.zeros_like(roughness)
        for number, bsdf in zip(numbers, bsdfs, strict=True):
            roughness[number], kept[number] = _alpha(bsdf), _diffuse_kept(bsdf)
        pure, other = (any(bool(has(bsdf.flags())) for bsdf in bsdfs) for has in (is_pure_delta, has_other_lobes))
        return cls(roughness, kept, pure, other)


def is_pure_delta(flags: Any) -> Any:
    """Whether a BSDF with these flags has delta lobes alone."""
    return mi.has_flag(flags, mi.BSDFFlags.Delta) & ~mi.has_flag(flags, mi.BSDFFlags.Smooth)


def has_other_lobes(flags: Any) -> Any:
    """Whether a BSDF with these flags has lobes beside a diffuse one, and not delta lobes alone."""
    smooth = mi.has_flag(flags, mi.BSDFFlags.Smooth)
    return smooth & (mi.has_flag(flags, mi.BSDFFlags.Delta) | mi.has_flag(flags, mi.BSDFFlags.Glossy))


def _alpha(bsdf: Any) -> float:
    """The α of a BSDF: the mean of its roughness parameters; without any, 0 for pure delta lobes, otherwise 1."""
    alphas = [
        mean ** (2 if "roughness" in key else 1)  # of `principled`: α = roughness²
        for key, mean in _read_means(bsdf, ROUGHNESS).items()
    ]
    if alphas:
        return float(np.clip(np.mean(alphas), 0, 1))
    return 0.0 if is_pure_delta(bsdf.flags()) else 1.0


def _diffuse_kept(bsdf: Any) -> float:
    """The share of the diffuse reflectance that a BSDF includes when only its other lobes are evaluated.

    It is 0 for all but Mitsuba's `principled`, alone or nested: that always evaluates all of its lobes, of which the
    diffuse one has about the share (1 − metallic) (1 − spec_trans) of the base colour; textures enter by their means.
    """
    if not _read_means(bsdf, {"base_color"}):
        return 0.0
    metallic, passes = (np.mean([*_read_means(bsdf, {name}).values()] or [0.0]) for name in ("metallic", "spec_trans"))
    return float((1 - metallic) * (1 - passes))


def _read_means(bsdf: Any, names: Set[str]) -> dict[str, float]:
    """The parameters of these names in a BSDF and in nested ones: means, by key."""
    return {
        key: float(np.mean(np.array(value)))
        for key, value in mi.traverse(bsdf)
        if names & set(key.split(".")) and key.rsplit(".", 1)[-1] in names | {"value", "data"}
    }
