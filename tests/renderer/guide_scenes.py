"""Small scenes whose guides can be calculated: squares, lamps, and the rays of a view."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.keys import make_key
from photonfarm.core.records import Guides
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.view_rays import GRID
from photonfarm.scene.spec import GuideSpec, SceneSpec
from photonfarm.scene.spec_loading import parse_spec
from photonfarm.scene.view import Camera, View

mi = backend.load(threads=1)

from photonfarm.renderer.bdpt.recording import Recorders  # noqa: E402
from photonfarm.renderer.scene.guides import view_guides  # noqa: E402 - after the variant is set
from photonfarm.renderer.scene.materials import Materials  # noqa: E402
from photonfarm.renderer.scene.view_rays import ViewCameras  # noqa: E402

Images = NDArray[np.float64]
Shape = dict[str, Any]

WIDTH, HEIGHT = 24, 16
AHEAD = View(np.array([0, 0, 3], np.float32), np.array([0, 0, 0], np.float32))
KEY = make_key("view", "of a test")
NOWHERE = np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32)
RADIANCE = np.array([5.0, 3.0, 1.0])
GREY = np.array([0.5, 0.4, 0.3])


def spec(width: int = WIDTH, height: int = HEIGHT, **changes: Any) -> SceneSpec:
    point = {"min": [-1, -1, -1], "max": [1, 1, 1]}
    described = {
        "name": "guides",
        "scene": {"builtin": "cornell"},
        "view": {"origin": point, "look_at": point, "fov_deg": 40},
        "film": {"width": width, "height": height},
    }
    return parse_spec({**described, **changes}, where="test")


def scene_of(**shapes: Shape) -> Any:
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


def known(
    scene: Any, view: View = AHEAD, *, light_samples: int = 3, lights_in_glass: bool = False, **of_spec: Any
) -> Guides:
    """The guides of a view."""
    return next(of_keys(scene, view, [KEY], light_samples, lights_in_glass=lights_in_glass, **of_spec))


def of_keys(
    scene: Any, view: View, keys: list[bytes], light_samples: int, *, lights_in_glass: bool = False, **of_spec: Any
) -> Iterator[Guides]:
    """The guides of a view by several keys, one after the other."""
    recorders = Recorders() if len(keys) > 1 else None
    wanted = GuideSpec(light_samples=light_samples, lights_in_glass=lights_in_glass)
    for key in keys:
        materials = Materials.of(scene)
        cameras = ViewCameras.of([view], spec(**of_spec))
        ((_, found),) = view_guides(scene, cameras, spec(**of_spec), wanted, [key], materials, NOWHERE, recorders)
        yield found


def some_keys(count: int, of: str = "key") -> list[bytes]:
    return [make_key(of, number) for number in range(count)]


def rgb(colour: NDArray[np.float64]) -> Shape:
    return {"type": "rgb", "value": colour.tolist()}


def diffuse(colour: NDArray[np.float64] = GREY) -> Shape:
    return {"type": "diffuse", "reflectance": rgb(colour)}


BLACK = diffuse(np.zeros(3))


def square(place: tuple[float, float, float], facing: tuple[float, float, float], size: float, **more: Any) -> Shape:
    """A square of half side `size` around a point, facing a way along the z or y axis."""
    up = [0, 0, 1] if facing[1] else [0, 1, 0]
    turn = mi.ScalarTransform4f().look_at(origin=list(place), target=np.add(place, facing).tolist(), up=up)
    return {"type": "rectangle", "to_world": turn @ mi.ScalarTransform4f().scale(size), **more}


def lamp(
    place: tuple[float, float, float], facing: tuple[float, float, float], size: float, radiance: Images = RADIANCE
) -> Shape:
    return square(place, facing, size, bsdf=BLACK, emitter={"type": "area", "radiance": rgb(radiance)})


def centre(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return image[HEIGHT // 2, WIDTH // 2]


def grid_rays(view: View, of: SceneSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The eye (3,), and unit directions through the grid of each pixel, (H, W, 16, 3)."""
    camera = Camera.of(view, of)
    steps = (np.arange(GRID) + 0.5) / GRID
    return camera.origin, np.stack([camera.rays(u, v) for v in steps for u in steps], axis=2).astype(np.float64)
