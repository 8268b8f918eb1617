"""The materials of the built-in rooms: Mitsuba descriptions, with textures made here."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from photonfarm.core.keys import Stream, make_key

Colour = tuple[float, float, float]


def rgb(colour: Colour) -> dict[str, Any]:
    """A linear RGB colour."""
    return {"type": "rgb", "value": list(colour)}


def diffuse(colour: Colour) -> dict[str, Any]:
    """A matte surface, seen from its front only."""
    return {"type": "diffuse", "reflectance": rgb(colour)}


def textured(image: NDArray[np.float32], repeat: tuple[float, float] = (1, 1)) -> dict[str, Any]:
    """A matte surface with an image (H, W, 3) of linear reflectances."""
    bitmap = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(image),
        "raw": True,  # reflectances as they are, not sRGB-encoded
        "to_uv": mi.ScalarTransform4f().scale([*repeat, 1]),
    }
    return {"type": "diffuse", "reflectance": bitmap}


def glossy(colour: Colour, alpha: float) -> dict[str, Any]:
    """Lacquer or plastic: a matte base under a rough dielectric coat."""
    return {"type": "roughplastic", "diffuse_reflectance": rgb(colour), "alpha": alpha, "nonlinear": True}


def metal(material: str, alpha: float) -> dict[str, Any]:
    """A brushed metal by its name in Mitsuba's table of indices (Au, Cu, Al, …)."""
    return {"type": "roughconductor", "material": material, "alpha": alpha, "distribution": "ggx"}


def mirror() -> dict[str, Any]:
    """A silvered mirror."""
    return {"type": "conductor", "material": "none", "specular_reflectance": rgb((0.92, 0.93, 0.92))}


def glass() -> dict[str, Any]:
    """The surface of a solid piece of glass."""
    return {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}


def planks(colour: Colour, rows: int = 16, size: int = 256) -> NDArray[np.float32]:
    """Wooden boards along u, (size, size, 3): each its own tone, with grain and dark joints."""
    random = Stream(make_key("texture", "planks"), "tones")
    tone = 0.8 + 0.4 * random.uniform(rows, 2)
    grain = 1 + 0.10 * (random.uniform(size) - 0.5)
    v, u = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    row = v * rows // size
    shift = (random.uniform(rows) * size).astype(int)[row]
    half = ((u + shift) % size) * 2 // size
    shade = tone[row, half] * grain[v]
    edge = (v * rows % size < rows) | ((u + shift) % (size // 2) == 0)
    return np.asarray(np.where(edge, 0.45, shade)[..., None] * np.array(colour), np.float32)


def rug(field: Colour, figure: Colour, size: int = 128) -> NDArray[np.float32]:
    """A woven rug, (size, size, 3): a border, and rhombs on the field."""
    v, u = np.meshgrid(np.linspace(-1, 1, size), np.linspace(-1, 1, size), indexing="ij")
    rhombs = (np.abs((u * 3) % 1 - 0.5) + np.abs((v * 4) % 1 - 0.5)) < 0.28
    rim = np.maximum(np.abs(u), np.abs(v))
    drawn = ((rim < 0.82) & rhombs) | ((rim > 0.86) & (rim < 0.93))
    return np.asarray(np.where(drawn[..., None], np.array(figure), np.array(field)), np.float32)


def painting(size: int = 96) -> NDArray[np.float32]:
    """A picture for the wall, (size, size, 3): a sun over hills. Its first row is the lower edge."""
    y, x = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size), indexing="ij")
    image = np.empty((size, size, 3))
    image[:] = np.array([0.75, 0.60, 0.42]) * (0.75 + 0.35 * y[..., None])
    image[(x - 0.62) ** 2 + (y - 0.66) ** 2 < 0.018] = (0.80, 0.25, 0.08)
    hills: tuple[tuple[float, float, float, Colour], ...] = (
        (0.46, 0.10, 7.0, (0.28, 0.36, 0.36)),
        (0.32, 0.08, 9.0, (0.12, 0.24, 0.26)),
        (0.18, 0.06, 5.0, (0.05, 0.12, 0.15)),
    )
    for height, swing, waves, colour in hills:
        image[y < height + swing * np.sin(waves * x + 10 * height)] = colour
    return np.asarray(image, np.float32)
