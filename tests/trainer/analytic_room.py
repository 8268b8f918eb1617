"""A scene whose clean images are known in closed form: a box in a room with a point light, rendered with numpy.

The room is the cube [-1, 1]³; a small cube stands anywhere on its floor and may be removed; a light that shines
downward with the cosine hangs anywhere under the ceiling, in the middle of a small emitting quad. Walls and cube are
diffuse, light is direct only. Half-estimates are the clean image times gamma noise of mean 1, hence unbiased.
"""

import itertools

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.keys import Stream, make_key
from photonfarm.core.records import F32, STATIC, BasePointCloud, Geometry, Photons, ViewBuffers, Visibility
from photonfarm.scene.modification import Modification, rebuild, sample_surface
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, View

CUBE_HALF = 0.3
CUBE_REST = np.array([0.0, -0.7, 0.0])
LIGHT_HALF = 0.15
LIGHT_REST = np.array([0.0, 0.95, 0.0])
INTENSITY = np.array([6.0, 5.5, 5.0])
GLOW = np.array([2.0, 1.9, 1.8])
WALLS = np.array([[0.8, 0.2, 0.2], [0.2, 0.8, 0.2], [0.7, 0.7, 0.7], [0.8, 0.8, 0.8], [0.3, 0.4, 0.8], [0.8, 0.8, 0.5]])
CUBE_ALBEDO = np.array([0.6, 0.5, 0.2])


def analytic_spec(
    size: int = 32, points: int = 1024, *, moving: bool = True, photons: int = 0, exposure: float = 1.0
) -> SceneSpec:
    box = {"min": [-0.8, -0.8, -0.8], "max": [0.8, 0.8, 0.8]}
    described = {
        "name": "analytic",
        "content": "box-3696",
        "credits": {"title": "A closed form", "author": "Lambert & Sons", "licence": "CC0-1.0"},
        "scene": {"builtin": "cornell"},
        "exposure": exposure,
        "view": {"origin": box, "look_at": box, "fov_deg": 75, "near": 0.05, "far": 10},
        "film": {"width": size, "height": size},
        "photons": {"paths": photons, "depth": 2} if photons else {"paths": 0},
        "points": points,
    }
    cube = {"name": "cube", "shapes": ["cube"], "at": CUBE_REST.tolist()}
    cube["box"] = {"min": [-0.65, -0.7, -0.65], "max": [0.65, -0.7, 0.65]}
    light = {"name": "light", "shapes": ["light"], "at": LIGHT_REST.tolist()}
    light["box"] = {"min": [-0.5, 0.95, -0.5], "max": [0.5, 0.95, 0.5]}
    if moving:
        described |= {"objects": [cube], "lights": [light]}
    return SceneSpec.model_validate(described)


# ---------------------------------------------------------------------------------------------------------- rendering


def _slab(origin: NDArray, direction: NDArray, centre: NDArray, half: float) -> tuple[NDArray, NDArray]:
    """Distances at which rays enter and leave a cube; (…,) each."""
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = ((centre + sign * half - origin) / direction for sign in (-1, 1))
    return np.fmax.reduce(np.fmin(low, high), axis=-1), np.fmin.reduce(np.fmax(low, high), axis=-1)


def _face(point: NDArray, centre: NDArray, half: float) -> tuple[NDArray, NDArray]:
    """Index 0…5 and outward normal of the cube's face that a point lies on."""
    offset = (point - centre) / half
    axis = np.abs(offset).argmax(axis=-1)
    sign = np.sign(np.take_along_axis(offset, axis[..., None], axis=-1))[..., 0]
    return 2 * axis + (sign > 0), np.eye(3)[axis] * sign[..., None]


def render(spec: SceneSpec, modification: Modification, view: View) -> tuple[F32, ViewBuffers]:
    """The clean image (H, W, 3) and the image-space buffers."""
    shift, present = _shift(spec, modification)
    cube, light = CUBE_REST + shift[0], LIGHT_REST + shift[1]
    camera = Camera.of(view, spec)
    ray = camera.rays().astype(np.float64)
    eye = camera.origin

    distance = _slab(eye, ray, np.zeros(3), 1.0)[1]
    wall, normal = _face(eye + ray * distance[..., None], np.zeros(3), 1.0)
    albedo, normal = WALLS[wall], -normal
    enter, leave = _slab(eye, ray, cube, CUBE_HALF)
    on_cube = present[0] & (enter < leave) & (leave > 0)
    reach = np.where(enter > 0, enter, leave)
    on_cube &= reach < distance
    distance = np.where(on_cube, reach, distance)
    point = eye + ray * distance[..., None]
    normal = np.where(on_cube[..., None], _face(point, cube, CUBE_HALF)[1], normal)
    albedo = np.where(on_cube[..., None], CUBE_ALBEDO, albedo)

    with np.errstate(divide="ignore", invalid="ignore"):
        to_quad = (light[1] - eye[1]) / ray[..., 1]
    at_quad = eye + ray * to_quad[..., None]
    on_light = (to_quad > 0) & (to_quad < distance) & (np.abs(at_quad - light)[..., [0, 2]].max(axis=-1) < LIGHT_HALF)

    to_light = light - point
    squared = (to_light**2).sum(axis=-1)
    to_light /= np.sqrt(squared)[..., None]
    enter, leave = _slab(point + 1e-4 * normal, to_light, cube, CUBE_HALF)
    shadow = present[0] & (enter < leave) & (leave > 0) & (enter < np.sqrt(squared))
    cosines = np.clip((normal * to_light).sum(axis=-1), 0, None) * np.clip(to_light[..., 1], 0, None)
    radiance = albedo / np.pi * INTENSITY * (~shadow * cosines / squared)[..., None]

    distance = np.where(on_light, to_quad, distance)
    radiance = np.where(on_light[..., None], np.where(eye[1] < light[1], GLOW, 0), radiance)
    albedo = np.where(on_light[..., None], 0, albedo)
    normal = np.where(on_light[..., None], [0, -1, 0], normal)
    depth = distance * (ray @ camera.forward)
    buffers = ViewBuffers(depth.astype(np.float32), albedo.astype(np.float32), normal.astype(np.float32))
    return radiance.astype(np.float32), buffers


def _shift(spec: SceneSpec, modification: Modification) -> tuple[NDArray, NDArray]:
    """The shifts of cube and light from where they rest, (2, 3), and whether they are there, (2,)."""
    if not spec.groups:
        return np.zeros((2, 3)), np.ones(2, bool)
    return modification.translation.astype(np.float64), modification.present


def sees(spec: SceneSpec, modification: Modification, view: View, position: F32) -> NDArray[np.bool_]:
    """Which points an eye sees, be they in its image or not, by an exact query: nothing lies between, (P,)."""
    eye, (shift, present) = view.origin.astype(np.float64), _shift(spec, modification)
    to_point = position - eye
    enter, leave = _slab(eye, to_point, CUBE_REST + shift[0], CUBE_HALF)
    first = np.where(enter > 0, enter, leave)
    behind_cube = present[0] & (enter < leave) & (leave > 0) & (first < 1 - 1e-5)
    light = LIGHT_REST + shift[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = (light[1] - eye[1]) / to_point[:, 1]
        at_quad = np.abs(eye + to_point * crossing[:, None] - light)[:, [0, 2]].max(axis=1)
    behind_light = (crossing > 0) & (crossing < 1 - 1e-5) & (at_quad < LIGHT_HALF)
    return ~behind_cube & ~behind_light


def visibility(
    spec: SceneSpec, cloud: BasePointCloud, modification: Modification, view: View, photons: Photons | None = None
) -> Visibility:
    """What a view sees of the cloud and of the photons."""
    camera = Camera.of(view, spec)

    def seen(position: F32) -> NDArray[np.bool_]:
        x, y, z = camera.world_to_camera @ np.pad(position, ((0, 0), (0, 1)), constant_values=1).astype(np.float64).T
        ahead = (spec.view.near < z) & (z < spec.view.far)
        column = np.floor(camera.focal_px * x / np.where(ahead, z, 1) + camera.width / 2)
        row = np.floor(camera.focal_px * y / np.where(ahead, z, 1) + camera.height / 2)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        return ahead & inside & sees(spec, modification, view, position)

    position, present = rebuild(cloud, modification)
    if photons is None:
        return Visibility(present & seen(position), np.zeros(0, np.bool_))
    return Visibility(present & seen(position), (photons.bounce >= 0) & seen(photons.position))


def trace(spec: SceneSpec, modification: Modification, seed: int) -> Photons:
    """Photons of a configuration: first hits of light that leaves downward with the cosine; later slots are empty."""
    paths = spec.photons.paths
    rng = np.random.default_rng(seed)
    radius, angle = np.sqrt(rng.random(paths)), 2 * np.pi * rng.random(paths)
    direction = np.stack([radius * np.cos(angle), -np.sqrt(1 - radius**2), radius * np.sin(angle)], axis=1)
    cube, light = CUBE_REST + modification.translation[0], LIGHT_REST + modification.translation[1]
    distance = _slab(light, direction, np.zeros(3), 1.0)[1]
    normal = -_face(light + direction * distance[:, None], np.zeros(3), 1.0)[1]
    enter, leave = _slab(light, direction, cube, CUBE_HALF)
    on_cube = modification.present[0] & (enter < leave) & (enter > 0) & (enter < distance)
    distance = np.where(on_cube, enter, distance)
    position = light + direction * distance[:, None]
    normal = np.where(on_cube[:, None], _face(position, cube, CUBE_HALF)[1], normal)
    power = np.broadcast_to(np.pi * INTENSITY / paths, (paths, 3))
    empty = np.zeros((paths * (spec.photons.depth - 1), 3))
    vectors = (np.concatenate([x, empty]).astype(np.float32) for x in (position, direction, normal, power))
    return Photons(*vectors, np.repeat(np.array([0, -1], np.int8), [paths, len(empty)]))


def analytic_base(spec: SceneSpec) -> tuple[Geometry, BasePointCloud]:
    """Walls, cube and light quad as triangles, and the base cloud sampled from them."""
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    quads = [np.flatnonzero(corners[:, axis] == side)[[0, 1, 3, 2]] for axis in range(3) for side in (-1, 1)]
    quad = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
    vertices = np.concatenate([corners, CUBE_REST + CUBE_HALF * corners, LIGHT_REST + LIGHT_HALF * quad])
    squares = np.array([*quads, *(8 + np.array(quads)), [16, 17, 18, 19]])
    faces = squares[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    shape_group = np.array([STATIC, 0, 1] if spec.groups else [STATIC] * 3, np.int16)
    geometry = Geometry(
        vertices.astype(np.float32),
        faces.astype(np.uint32),
        np.repeat([0, 1, 2], [12, 12, 2]).astype(np.int32),
        shape_group,
    )
    face, weight = sample_surface(geometry, spec.points, Stream(make_key(spec.scene_id), "cloud"))
    position = (vertices[faces[face]] * weight[..., None]).sum(axis=1)
    shape = geometry.face_shape[face]
    wall, outward = _face(position, np.zeros(3), 1.0)
    side = _face(position, CUBE_REST, CUBE_HALF)[1]
    normal = np.select([shape[:, None] == 0, shape[:, None] == 1], [-outward, side], np.array([0.0, -1, 0]))
    albedo = np.select([shape[:, None] == 0, shape[:, None] == 1], [WALLS[wall], CUBE_ALBEDO], 0.0)
    emission = np.where(shape[:, None] == 2, GLOW, 0.0)
    columns = (x.astype(np.float32) for x in (position, normal, albedo, emission))
    return geometry, BasePointCloud(*columns, shape_group[shape], face)
