"""Pictures of a few held-out views at validations, in the run's folder, so that others can watch them improve."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from photonfarm.core.errors import store_errors
from photonfarm.core.files import whole_file
from photonfarm.core.pictures import display
from photonfarm.core.records import F32
from photonfarm.farm.training import VIEWS

SHOWN = 4  # the most views
MOST = 24  # the most pictures kept; beyond, every second one goes, so that early ones become rare
_NAME = re.compile(r"step-(\d{8})\.png")


def write_views(run: Path, scene_id: str, step: int, rows: tuple[int, ...], predictions: F32) -> None:
    """Write the first predictions, exposed linear radiance (B, H, W, 3), side by side as a display shows them.

    The PNG's texts `scene` and `rows` name what they belong to in the store. Raises StoreError if the disk refuses.
    """
    from PIL import Image, PngImagePlugin

    rows, folder = rows[:SHOWN], run / VIEWS
    about = PngImagePlugin.PngInfo()
    about.add_text("scene", scene_id)
    about.add_text("rows", " ".join(map(str, rows)))
    strip = np.concatenate([display(image, 1.0) for image in predictions[: len(rows)]], axis=1)
    with store_errors("write pictures of held-out views", folder):
        with whole_file(folder / f"step-{step:08d}.png") as part:
            Image.fromarray(strip).save(part, "PNG", pnginfo=about)
        _thin_out(folder)


def _thin_out(folder: Path) -> None:
    files = sorted(file for file in folder.iterdir() if _NAME.fullmatch(file.name))
    if len(files) > MOST:
        for file in files[1:-1:2]:
            file.unlink(missing_ok=True)
