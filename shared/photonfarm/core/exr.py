"""Arrays as layers of an OpenEXR image: whole or not at all, without loss. It needs the package OpenEXR.

Shape letters: H W image.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import StoreError, store_errors
from photonfarm.core.files import whole_file


def write_layers(file: Path, layers: Mapping[str, NDArray[Any]], attributes: Mapping[str, Any]) -> None:
    """Write an image with layers by name, (H, W, 3) or (H, W), float16 or float32; "" is the one shown first.

    Channels are R, G, B of colours, X, Y, Z of normals, Z of depths, and V of other single values. Raises StoreError
    if OpenEXR is not installed, or the disk refuses.
    """
    try:
        import OpenEXR
    except ModuleNotFoundError as error:
        raise StoreError(f"{file}: needs the package OpenEXR; pip install 'photonfarm[export]'") from error
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    with store_errors("write an image", file), whole_file(file) as part:
        try:
            with OpenEXR.File(header, _channels(layers)) as image:
                image.write(str(part))
        except RuntimeError as error:  # OpenEXR's own, which names the cause
            raise OSError(None, str(error), str(file)) from error


def _channels(layers: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    found: dict[str, NDArray[Any]] = {}
    for layer, values in layers.items():
        if values.ndim == 3:
            names = "XYZ" if "normal" in layer else "RGB"
            parts = {name: values[..., i] for i, name in enumerate(names)}
        else:
            parts = {"Z" if "depth" in layer else "V": values}
        contiguous = {name: np.ascontiguousarray(part) for name, part in parts.items()}  # OpenEXR minds no strides
        found |= {f"{layer}.{name}" if layer else name: part for name, part in contiguous.items()}
    return found
