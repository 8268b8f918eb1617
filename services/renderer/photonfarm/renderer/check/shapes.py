"""The shapes of a loaded scene, as facts that a person chooses movable groups by."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from photonfarm.shared.scene.spec import SceneSpec, shape_ids
from photonfarm.shared.scene.spec_loading import load_spec, parse_spec

_PLUGINS = {
    "SmoothDiffuse": "diffuse",
    "SmoothDielectric": "dielectric",
    "ThinDielectric": "thindielectric",
    "RoughDielectric": "roughdielectric",
    "SmoothConductor": "conductor",
    "RoughConductor": "roughconductor",
    "SmoothPlastic": "plastic",
    "RoughPlastic": "roughplastic",
    "Principled": "principled",
    "PrincipledThin": "principledthin",
    "TwoSided": "twosided",
    "MaskBSDF": "mask",
    "BumpMap": "bumpmap",
    "NormalMap": "normalmap",
    "BlendBSDF": "blendbsdf",
    "Null": "null",
}
"""Mitsuba's names of its material plugins, by the names of their classes."""


@dataclass(frozen=True, slots=True)
class ShapeFacts:
    """One shape of a scene at rest."""

    id: str  # as a spec names it; empty if the scene file gives it none
    group: str | None  # the movable group of the spec that it belongs to
    material: str  # the plugins that it is made of, from the outermost
    triangles: int | None  # None of spheres, disks and cylinders, which are no meshes
    emits: bool
    min: tuple[float, float, float]  # of its box
    max: tuple[float, float, float]

    def document(self) -> dict[str, Any]:
        """All fields, for JSON."""
        return asdict(self)

    def row(self) -> tuple[str, ...]:
        """All fields as text, in the order of `HEAD`."""
        low, high = (" ".join(f"{value:.4g}" for value in corner) for corner in (self.min, self.max))
        triangles = "–" if self.triangles is None else f"{self.triangles:,}"
        light = "light" if self.emits else ""
        return self.id or "(no id)", self.group or "", self.material, triangles, light, low, high


HEAD = ("id", "group", "material", "triangles", "emits", "box from", "to")


def facts_of(scene: Any, group_of: Mapping[str, str]) -> list[ShapeFacts]:
    """The facts of each shape of a Mitsuba scene, in its order; `group_of` gives the group of a shape id."""
    return [_facts(shape, group_of.get(shape.id())) for shape in scene.shapes()]


def groups_by_shape(spec: SceneSpec) -> dict[str, str]:
    """The name of the movable group of each shape id that belongs to one."""
    return {shape: group.name for group in spec.groups for shape in shape_ids(group)}


def listed(name: str) -> list[ShapeFacts]:
    """The shapes of a spec's scene, or of a Mitsuba scene file (`.xml`), without rendering anything.

    Raises SpecError as loading does.
    """
    from photonfarm.renderer.scene import backend
    from photonfarm.shared.scene.spec_loading import find_spec

    path = Path(name)
    if path.suffix == ".xml":
        spec, beside = _bare(path), path.absolute().parent
    else:
        spec, beside = load_spec(name), find_spec(name).parent
    backend.load()
    from photonfarm.renderer.scene.loading import load_scene

    return facts_of(load_scene(spec, beside), groups_by_shape(spec))


def _bare(path: Path) -> SceneSpec:
    """A spec that says nothing but the scene file."""
    anywhere = {"min": (0.0, 0.0, 0.0), "max": (1.0, 1.0, 1.0)}
    described = {
        "name": "scene",
        "scene": {"file": str(path.absolute())},
        "view": {"origin": anywhere, "look_at": anywhere},
    }
    return parse_spec(described, where=str(path))


def _facts(shape: Any, group: str | None) -> ShapeFacts:
    box = shape.bbox()
    return ShapeFacts(
        shape.id(),
        group,
        _material(shape.bsdf()),
        int(shape.face_count()) if shape.is_mesh() else None,
        bool(shape.is_emitter()),
        tuple(box.min),
        tuple(box.max),
    )


def _material(bsdf: Any) -> str:
    """The plugins of a BSDF and of those in it, each once, and its id if it has one."""
    if bsdf is None:
        return "none"
    classes = re.findall(r"\b([A-Z]\w*)\[", str(bsdf))
    plugins = dict.fromkeys(_PLUGINS[name] for name in classes if name in _PLUGINS)
    kinds = "/".join(plugins) or bsdf.class_name()
    return f"{kinds} ({bsdf.id()})" if bsdf.id() else kinds
