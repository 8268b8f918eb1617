"""Specs as the benchmarks change them."""

from __future__ import annotations

from bench.harness.results import ROOT
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec


def ready_spec(name: str) -> SceneSpec:
    """The spec of scenes/, else the built-in one; raises SpecError where it is neither, or its file is missing."""
    path = ROOT / "scenes" / f"{name}.toml"
    return load_spec(path if path.is_file() else name)


def square(spec: SceneSpec, size: int) -> SceneSpec:
    """The scene with images of so many pixels a side."""
    return spec.model_copy(update={"film": spec.film.model_copy(update={"width": size, "height": size})})


def in_passes(spec: SceneSpec, half_spp: int) -> SceneSpec:
    """The scene with so many samples per pixel in a half-estimate."""
    return spec.model_copy(update={"transport": spec.transport.model_copy(update={"half_spp": half_spp})})
