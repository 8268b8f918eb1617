"""A loaded Mitsuba scene in LuxCore's words, where LuxCore can express it.

Can be: meshes, rectangles, cubes, spheres, disks (the round ones as fine meshes with smooth normals); uniform diffuse,
twosided, mirror and smooth glass; area lights and point lights of one colour; a square perspective image. Rough mirrors
get Schlick's distribution, LuxCore's only one, which is close to GGX and not to Beckmann's.

LuxCore's matte reflects from both sides, Mitsuba's diffuse from its front: here it gets a black back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Properties = dict[str, Any]
BLACK = "black"


class NotExpressibleError(Exception):
    """The scene has something that LuxCore's peer cannot be given; the message says what."""


@dataclass(slots=True)
class LuxCoreScene:
    """Meshes as arrays and everything else as LuxCore's properties."""

    properties: Properties = field(default_factory=dict)
    meshes: dict[str, NDArray[Any]] = field(default_factory=dict)  # "NAME.vertices" (V, 3), ".faces", ".normals"
    differences: set[str] = field(default_factory=set)  # what is only almost the same


def translate(scene: Any) -> LuxCoreScene:
    """The scene for LuxCore. Raises NotExpressibleError."""
    result = LuxCoreScene()
    result.properties |= _matte(BLACK, [0.0, 0.0, 0.0])
    for k, shape in enumerate(scene.shapes()):
        _add_shape(result, f"s{k}", shape)
    for k, emitter in enumerate(scene.emitters()):
        if emitter.class_name() != "AreaLight":
            _add_light(result, f"l{k}", emitter)
    _add_camera(result, scene.sensors()[0])
    return result


def _add_shape(result: LuxCoreScene, name: str, shape: Any) -> None:
    vertices, faces, normals = _triangles(shape)
    result.meshes |= {f"{name}.vertices": vertices, f"{name}.faces": faces}
    if normals is not None:
        result.meshes[f"{name}.normals"] = normals
        result.differences |= {"round shapes are meshes"} if not shape.is_mesh() else set()
    _add_material(result, name, shape.bsdf(), _radiance(shape))
    result.properties |= {f"scene.objects.{name}.shape": name, f"scene.objects.{name}.material": name}


def _triangles(shape: Any) -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.float32] | None]:
    """Vertices, faces that turn counter-clockwise seen from the front, and normals of smooth shapes."""
    import mitsuba as mi

    from photonfarm.core.errors import SpecError
    from photonfarm.renderer.scene.base_cloud import triangles_of

    try:
        triangles = triangles_of(shape)
    except SpecError as error:
        raise NotExpressibleError(str(error)) from error
    corners = triangles.vertices[triangles.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    solid = np.linalg.norm(normal, axis=1) > 1e-12
    sample = shape.sample_position(0.0, mi.Point2f(0.4, 0.3))
    point, facing = (np.array(value, np.float64).ravel() for value in (sample.p, sample.n))
    distance = np.where(solid, np.linalg.norm(corners.mean(axis=1) - point, axis=1), np.inf)
    flipped = float(normal[np.argmin(distance)] @ facing) < 0
    faces = triangles.faces[solid]
    return triangles.vertices, faces[:, ::-1] if flipped else faces, _smooth_normals(shape, triangles.vertices, flipped)


def _smooth_normals(shape: Any, vertices: NDArray[np.float32], flipped: bool) -> NDArray[np.float32] | None:
    import mitsuba as mi

    if shape.is_mesh():
        if not shape.has_vertex_normals():
            return None
        return np.array(shape.vertex_normals_buffer(), np.float32).reshape(-1, 3)
    if shape.class_name() != "Sphere":
        return None
    centre = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)[:3, 3]
    outward = vertices - centre
    unit = outward / np.linalg.norm(outward, axis=1, keepdims=True)
    return np.asarray(-unit if flipped else unit, np.float32)


# ------------------------------------------------ Materials and lights ------------------------------------------------


def _add_material(result: LuxCoreScene, name: str, bsdf: Any, radiance: list[float] | None) -> None:
    sides = _sides(bsdf)
    if sides is None:
        result.properties |= _material(result, name, bsdf)
        front = name
    else:
        front, back = f"{name}f", f"{name}b" if sides[1] is not None else BLACK
        result.properties |= _material(result, front, sides[0])
        if sides[1] is not None:
            result.properties |= _material(result, back, sides[1])
        prefix = f"scene.materials.{name}"
        result.properties |= {
            f"{prefix}.type": "twosided",
            f"{prefix}.frontmaterial": front,
            f"{prefix}.backmaterial": back,
        }
    if radiance is not None and any(radiance):
        result.properties[f"scene.materials.{front}.emission"] = radiance


def _sides(bsdf: Any) -> tuple[Any, Any | None] | None:
    """(front, back) of what differs between its sides, a back of None is black; None for glass."""
    if bsdf.class_name() == "TwoSidedBRDF":
        nested = _nested(bsdf)
        return nested[0], nested[-1]
    return None if bsdf.class_name() == "SmoothDielectric" else (bsdf, None)


def _nested(bsdf: Any) -> list[Any]:
    """The BSDFs that a BSDF holds, in order."""
    import mitsuba as mi

    found: list[Any] = []

    class Callback(mi.TraversalCallback):
        def put_value(self, *_: Any) -> None:
            pass

        def put_object(self, _name: str, value: Any, *_: Any) -> None:
            found.append(value)

        put = put_object

    bsdf.traverse(Callback())
    return [value for value in found if isinstance(value, mi.BSDF)]


def _material(result: LuxCoreScene, name: str, bsdf: Any) -> Properties:
    import mitsuba as mi

    kind, values = bsdf.class_name(), dict(mi.traverse(bsdf))
    prefix = f"scene.materials.{name}"
    if kind == "SmoothDiffuse":
        return _matte(name, _colour(values, "reflectance", kind))
    if kind in ("SmoothConductor", "RoughConductor"):
        if _colour(values, "eta", kind)[0] != 0:
            raise NotExpressibleError(f"a {kind} with Fresnel reflection")
        tint = _colour(values, "specular_reflectance", kind, [1.0, 1.0, 1.0])
        if kind == "SmoothConductor":
            return {f"{prefix}.type": "mirror", f"{prefix}.kr": tint}
        if "distribution = ggx" not in str(bsdf):
            result.differences.add("rough mirror: Schlick's distribution, which is GGX, for Beckmann's")
        alpha = _colour(values, "alpha", kind)[0]
        fresnel = {f"scene.textures.{name}.type": "fresnelcolor", f"scene.textures.{name}.kr": tint}
        rough = {f"{prefix}.uroughness": alpha, f"{prefix}.vroughness": alpha}
        return fresnel | rough | {f"{prefix}.type": "metal2", f"{prefix}.fresnel": name}
    if kind == "SmoothDielectric":
        eta = float(np.array(values["eta"]).ravel()[0])
        ones = [1.0, 1.0, 1.0]
        return {
            f"{prefix}.type": "glass",
            f"{prefix}.kr": ones,
            f"{prefix}.kt": ones,
            f"{prefix}.interiorior": eta,
            f"{prefix}.exteriorior": 1.0,
        }
    raise NotExpressibleError(f"material {kind}")


def _matte(name: str, colour: list[float]) -> Properties:
    return {f"scene.materials.{name}.type": "matte", f"scene.materials.{name}.kd": colour}


def _colour(values: dict[str, Any], key: str, kind: str, default: list[float] | None = None) -> list[float]:
    """RGB of a uniform spectrum. Raises NotExpressibleError for a texture."""
    if f"{key}.value" in values:
        numbers = np.array(values[f"{key}.value"], np.float64).ravel()
        return [float(x) for x in (numbers if numbers.size == 3 else np.repeat(numbers[:1], 3))]
    if default is not None and not any(name.startswith(key) for name in values):
        return default
    raise NotExpressibleError(f"a {kind} whose {key} is textured")


def _radiance(shape: Any) -> list[float] | None:
    import mitsuba as mi

    if not shape.is_emitter():
        return None
    return _colour(dict(mi.traverse(shape.emitter())), "radiance", "light")


def _add_light(result: LuxCoreScene, name: str, emitter: Any) -> None:
    import mitsuba as mi

    if emitter.class_name() != "PointLight":
        raise NotExpressibleError(f"light {emitter.class_name()}")
    values, prefix = dict(mi.traverse(emitter)), f"scene.lights.{name}"
    power = [4 * math.pi * x for x in _colour(values, "intensity", "light")]  # LuxCore's colour is a flux
    position = [float(x) for x in np.array(values["position"]).ravel()]
    result.properties |= {f"{prefix}.type": "point", f"{prefix}.position": position, f"{prefix}.color": power}


def _add_camera(result: LuxCoreScene, sensor: Any) -> None:
    import mitsuba as mi

    values = dict(mi.traverse(sensor))
    width, height = (int(x) for x in sensor.film().size())
    if sensor.class_name() != "PerspectiveCamera" or width != height:
        raise NotExpressibleError(f"a {sensor.class_name()} of {width}×{height} pixels")
    matrix = np.array(values["to_world"].matrix, np.float64).reshape(4, 4)
    origin, forward, up = matrix[:3, 3], matrix[:3, 2], matrix[:3, 1]
    prefix, row = "scene.camera", 2 / height
    # LuxCore's rasters count rows from H − 1 down to −1: the window is lowered by one row to see what Mitsuba sees
    window = [-1.0, 1.0, -1.0 - row, 1.0 - row]
    result.properties |= {
        f"{prefix}.screenwindow": window,
        f"{prefix}.type": "perspective",
        f"{prefix}.autofocus.enable": 0,
        f"{prefix}.lookat.orig": origin.tolist(),
        f"{prefix}.lookat.target": (origin + forward).tolist(),
        f"{prefix}.up": up.tolist(),
        f"{prefix}.fieldofview": float(np.array(values["x_fov"]).ravel()[0]),
        f"{prefix}.cliphither": float(values["near_clip"]),
        f"{prefix}.clipyon": float(values["far_clip"]),
    }
