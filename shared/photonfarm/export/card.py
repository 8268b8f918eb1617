"""The card of an export, README.md: what it is, whose it is and how to read it; with what Hugging Face reads of it."""

from __future__ import annotations

import json
from typing import Any

from photonfarm.core.errors import store_errors
from photonfarm.core.files import write_whole
from photonfarm.core.formatting import format_markdown_table
from photonfarm.export.columns import Column
from photonfarm.export.folder import DATA
from photonfarm.export.formats.format import Exported
from photonfarm.export.manifest import Manifest
from photonfarm.export.settings import FormatName

CARD = "README.md"

READING: dict[FormatName, str] = {
    "webdataset": """\
import glob
import webdataset

shards = sorted(glob.glob("{folder}/data/train-*.tar"))
for sample in webdataset.WebDataset(shards, shardshuffle=False).decode():  # names are in lower case
    print(sample["json"]["row"], sample["a.npy"].shape, sample["b.npy"].shape, sample["albedo.npy"].shape)
""",
    "exr": """\
import OpenEXR

with OpenEXR.File("{folder}/samples/00000000.exr") as image:
    layers = {{name: channel.pixels for name, channel in image.channels().items()}}
print(layers["RGB"].shape, layers["A"].shape, layers["B"].shape, layers["depth.Z"].shape)
""",
    "npz": """\
import numpy as np

with np.load("{folder}/samples/00000000.npz") as sample:
    print(sample["A"].shape, sample["B"].shape, sample["albedo"].shape, sample["camera_to_world"])
""",
    "parquet": """\
from datasets import load_dataset

samples = load_dataset("{folder}", split="train").with_format("numpy")
print(len(samples), samples[0]["A"].shape, samples[0]["B"].shape, samples[0]["albedo"].shape)
""",
}
"""How each format is read, by the library that most use."""

_SPLITS = {"train": "train", "held-out": "held_out"}
"""Splits by their names in files, and as `datasets` allows them."""

_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))


def write_card(exported: Exported) -> None:
    """Write the card; raises StoreError if the disk refuses."""
    with store_errors("write the card", exported.folder):
        write_whole(exported.folder / CARD, card(exported))


def card(exported: Exported) -> str:
    """The text of the card."""
    found, name = exported.manifest, exported.manifest.scene.name
    head = "\n".join(f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in _front(exported).items())
    reading = READING[found.settings.to].format(folder=exported.folder.name)
    return "\n".join([
        f"---\n{head}\n---\n",
        f"# {name}\n",
        f"{found.samples} samples of the scene {name}. Each has two noisy images A and B of one view, rendered by an "
        "unbiased bidirectional path tracer with seeds of their own: they are independent, and the mean of many such "
        "images is the true one. So the mean of (f − A)(f − B) estimates the squared error of an image f against the "
        "noise-free image. Values are linear and not clipped.\n",
        f"## Licence and credits\n\n{_credits(found)}\n",
        f"## Reading it\n\n```python\n{reading}```\n",
        f"## What a sample holds\n\n{_table(exported.contents.columns)}\n",
        f"## Where it came from\n\n{_origin(found)}\n",
    ])  # fmt: skip


def _front(exported: Exported) -> dict[str, Any]:
    """What stands above the card, as YAML."""
    found = exported.manifest
    licence = (found.credits or {}).get("licence")
    known = licence is not None and licence.lower().startswith(("cc0-", "cc-by-", "apache-", "mit"))
    head: dict[str, Any] = {"license": licence.lower() if licence and known else "other"}
    if licence and not known:
        head["license_name"] = licence
    size = next((name for end, name in _SIZES if found.samples < end), "n>10M")
    head |= {"pretty_name": found.scene.name, "tags": ["photonfarm", "rendering", "path-tracing", "denoising"]}
    head["size_categories"] = [size]
    if found.parts:
        splits = [split for split in _SPLITS if any(part.file.startswith(f"{DATA}/{split}-") for part in found.parts)]
        files = [{"split": _SPLITS[split], "path": f"{DATA}/{split}-*"} for split in splits]
        head["configs"] = [{"config_name": "default", "data_files": files}]
    if found.settings.to == "parquet":  # without it `datasets` takes arrays for lists, and reads them number by number
        head["dataset_info"] = {"features": [_feature(column) for column in exported.contents.columns]}
    return head


def _feature(column: Column) -> dict[str, Any]:
    """A column as `datasets` describes it."""
    value = "string" if column.dtype == "str" else column.dtype
    match len(column.shape):
        case 0:
            return {"name": column.name, "dtype": value}
        case 1:
            return {"name": column.name, "list": value}
        case axes:
            array = {f"array{axes}_d": {"shape": list(column.shape), "dtype": value}}
            return {"name": column.name, "dtype": array}


def _credits(found: Manifest) -> str:
    if found.credits is None:
        return (
            "The scene's spec names neither author nor licence ([credits]); ask who made the scene before sharing it."
        )
    lines = [f"- {key}: {value}" for key, value in found.credits.items() if value]
    return "\n".join([*lines, "\nThe licence is the scene's; photonfarm lays no claim to what it renders."])


def _table(columns: tuple[Column, ...]) -> str:
    shapes = [" × ".join(map(str, column.shape)) or "–" for column in columns]
    rows = [(f"`{c.name}`", c.dtype, shape, c.unit or "–", c.meaning) for c, shape in zip(columns, shapes, strict=True)]
    return format_markdown_table(("name", "type", "shape", "unit", "is"), rows)


def _origin(found: Manifest) -> str:
    about, camera = found.constants, found.constants["camera"]
    groups = ", ".join(about["groups"]) or "none: the scene is static"
    return "\n".join([
        f"- scene id {found.scene.id}, store {found.store}",
        f"- committed jobs {found.jobs} of {len(found.plans)} plans, rows {found.rows} of the store",
        f"- half-estimates of {about['half_spp']} samples per pixel each; exposure {about['exposure']:g} for display",
        f"- {camera['width']} × {camera['height']} pixels, field of view {camera['fov_deg']:g}° along the width",
        f"- movable groups, in the order of `modification`: {groups}",
        f"- held out: a share {found.settings.hold_out:g} of the configurations, chosen by a hash of their content",
        "- versions and plans: export.json",
    ])  # fmt: skip
