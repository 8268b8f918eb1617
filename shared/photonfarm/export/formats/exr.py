"""`--to exr`: an image per sample with a layer for everything, and `transforms.json` with the cameras."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from photonfarm.core.archives import write_arrays, write_layers
from photonfarm.core.errors import store_errors
from photonfarm.core.files import write_whole
from photonfarm.export.columns import HALVES, Contents, rows_in
from photonfarm.export.folder import SAMPLES
from photonfarm.export.formats.format import Exported
from photonfarm.export.snapshot import Snapshot, Values, camera_to_world, plain

SUFFIX = ".exr"
PACKAGES = ("OpenEXR",)
ONE_PER_FILE = True

TRANSFORMS = "transforms.json"


def write(file: Path, samples: Iterator[Values], contents: Contents) -> None:
    """Write the image of one sample; what is no image goes first, into an archive beside it."""
    (values,) = samples
    if contents.others:
        beside = {column.name: values[column.name] for column in contents.others}
        write_arrays(file.with_suffix(".npz"), beside, "exported samples")
    half_a, half_b = (values[name] for name in HALVES)
    layers = {"": (half_a + half_b) / np.float32(2)}
    layers |= {column.name: values[column.name] for column in contents.images}
    matrix = np.linalg.inv(values["camera_to_world"]).T  # OpenEXR multiplies row vectors
    said = json.dumps(plain(values, contents.facts) | contents.about)
    write_layers(file, layers, {"worldToCamera": np.ascontiguousarray(matrix, np.float32), "photonfarm": said})


def finish(exported: Exported) -> None:
    """Write the cameras of all images, as NeRF's programs read them."""
    camera = exported.contents.about["camera"]
    width, height = camera["width"], camera["height"]
    focal = {"fl_x": camera["focal_px"], "fl_y": camera["focal_px"], "cx": width / 2, "cy": height / 2}
    head = {"camera_model": "PINHOLE", "camera_angle_x": float(np.radians(camera["fov_deg"]))}
    frames = [_frame(exported.snapshot, row) for row in rows_in(exported.manifest.rows)]
    document = {**head, **focal, "w": width, "h": height, "up": camera["up"], "frames": frames}
    with store_errors("write the cameras", exported.folder):
        write_whole(exported.folder / TRANSFORMS, json.dumps(document, indent=1) + "\n")


def _frame(snapshot: Snapshot, row: int) -> Values:
    modification, view = snapshot.inputs(row)
    return {
        "file_path": f"{SAMPLES}/{row:08d}{SUFFIX}",
        "transform_matrix": camera_to_world(view, snapshot.spec).tolist(),
        "configuration_key": modification.key(snapshot.spec.radiance_id).hex(),
        "split": snapshot.split_of(row),
    }
