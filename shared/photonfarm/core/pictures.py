"""Arrays as pictures that a person can look at, and HTML pages from Jinja2 templates, each a file that needs no other.

For display only: nothing here is on the way to the store. Shape letters: H W image.
"""

from __future__ import annotations

import base64
import io
from base64 import b64encode
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape
from numpy.typing import NDArray

from photonfarm.core.records import F32

Picture = NDArray[np.uint8]  # (H, W, 3)

GAMMA = 2.2

EXACT = 96
"""The width up to which pictures are in pages without loss."""

V = TypeVar("V", np.uint8, np.float32)


def display_values(exposed: F32) -> F32:
    """clip(I, 0, 1)^(1/2.2) of exposed linear radiance, in any shape: what a display is given, in [0, 1]."""
    shown: F32 = np.clip(exposed, 0, 1) ** np.float32(1 / GAMMA)
    return shown


def display(radiance: F32, exposure: float) -> Picture:
    """Linear radiance (H, W, 3) as clip(exposure · I, 0, 1)^(1/2.2)."""
    return _bytes(display_values(exposure * np.nan_to_num(radiance)))


def draw_albedo(albedo: F32) -> Picture:
    """Reflectance (H, W, 3) in [0, 1], gamma 2.2."""
    return _bytes(display_values(albedo))


def draw_normal(normal: F32) -> Picture:
    """World normals (H, W, 3) as colours: −1…1 becomes 0…255."""
    return _bytes(0.5 + 0.5 * np.clip(normal, -1, 1))


def draw_depth(depth: F32) -> Picture:
    """Depth (H, W) in greys, near bright; 0 (nothing hit) is black."""
    hit = depth > 0
    far = np.percentile(depth[hit], 99) if hit.any() else 1.0
    return _bytes(np.repeat((hit * (1 - 0.9 * np.clip(depth / far, 0, 1)))[..., None], 3, axis=2))


def reduce_image(image: NDArray[V], most: int) -> NDArray[V]:
    """An image (H, W, C) of at most `most` pixels along each side: means over blocks, less a rest at the edges."""
    by = -(-max(image.shape[:2]) // most)
    if by == 1:
        return image
    height, width = (side // by for side in image.shape[:2])
    blocks = image[: height * by, : width * by].reshape(height, by, width, by, -1)
    return blocks.mean(axis=(1, 3)).astype(image.dtype)


def data_uri(picture: Picture, most: int | None = None) -> str:
    """The picture as a `data:` address: PNG, or WebP if it is wider than `EXACT`; of at most `most` pixels a side."""
    from PIL import Image

    stream = io.BytesIO()
    shown = picture if most is None else reduce_image(picture, most)
    kind = "PNG" if shown.shape[1] <= EXACT else "WEBP"
    Image.fromarray(shown).save(stream, kind, quality=90)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(stream.getvalue()).decode()}"


def _bytes(unit: NDArray[np.floating]) -> Picture:
    return np.round(255 * unit).astype(np.uint8)


HERE = Path(__file__).parent


def render_page(template: Path, **values: Any) -> str:
    """The page of a template; `page.html.j2`, which it may extend, lies beside this module. Text is escaped."""
    environment = Environment(
        loader=FileSystemLoader([template.parent, HERE]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"uri": data_uri, "breakable": breakable, "base64": lambda data: b64encode(data).decode()}
    return environment.get_template(template.name).render(**values)


def breakable(text: str) -> Markup:
    """A text whose names may break after an underscore."""
    return Markup(str(escape(text)).replace("_", "_<wbr>"))  # noqa: S704 - it is escaped
