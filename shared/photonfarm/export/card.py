"""What describes an export: its card README.md, for people and Hugging Face, and Croissant metadata, for programs.

The card says what it is, whose it is and how to read it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photonfarm.core.errors import store_errors
from photonfarm.core.files import write_whole
from photonfarm.core.formatting import format_markdown_table
from photonfarm.export.folder import DATA, FormatName, Manifest
from photonfarm.export.snapshot import Column, Contents, Snapshot

CARD = "README.md"


@dataclass(frozen=True, slots=True)
class Exported:
    """An export whose files of samples are written."""

    folder: Path
    snapshot: Snapshot
    contents: Contents
    manifest: Manifest


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
        write_whole(exported.folder / CARD, format_card(exported))


def format_card(exported: Exported) -> str:
    """The text of the card."""
    manifest, name = exported.manifest, exported.manifest.scene.name
    head = "\n".join(
        f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in _describe_head(exported).items()
    )
    reading = READING[manifest.settings.to].format(folder=exported.folder.name)
    parts = [
        f"---\n{head}\n---\n",
        f"# {name}\n",
        f"{manifest.samples} samples of the scene {name}. Each has two noisy images A and B of one view, rendered by "
        "an unbiased bidirectional path tracer with seeds of their own: they are independent, and the mean of many "
        "such images is the true one. So the mean of (f − A)(f − B) estimates the squared error of an image f against "
        "the noise-free image. Values are linear and not clipped.\n",
        f"## Licence and credits\n\n{_format_credits(manifest)}\n",
        f"## Reading it\n\n```python\n{reading}```\n",
        f"## What a sample holds\n\n{_format_table(exported.contents.columns)}\n",
        f"## Where it came from\n\n{_format_origin(manifest)}\n",
    ]
    return "\n".join(parts)


def _describe_head(exported: Exported) -> dict[str, Any]:
    """What stands above the card, as YAML."""
    manifest = exported.manifest
    licence = (manifest.credits or {}).get("licence")
    known = licence is not None and licence.lower().startswith(("cc0-", "cc-by-", "apache-", "mit"))
    head: dict[str, Any] = {"license": licence.lower() if licence and known else "other"}
    if licence and not known:
        head["license_name"] = licence
    size = next((name for end, name in _SIZES if manifest.samples < end), "n>10M")
    head |= {"pretty_name": manifest.scene.name, "tags": ["photonfarm", "rendering", "path-tracing", "denoising"]}
    head["size_categories"] = [size]
    if manifest.parts:
        splits = [
            split for split in _SPLITS if any(part.file.startswith(f"{DATA}/{split}-") for part in manifest.parts)
        ]
        files = [{"split": _SPLITS[split], "path": f"{DATA}/{split}-*"} for split in splits]
        head["configs"] = [{"config_name": "default", "data_files": files}]
    if (
        manifest.settings.to == "parquet"
    ):  # without it `datasets` takes arrays for lists, and reads them number by number
        head["dataset_info"] = {"features": [_describe_feature(column) for column in exported.contents.columns]}
    return head


def _describe_feature(column: Column) -> dict[str, Any]:
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


def _format_credits(manifest: Manifest) -> str:
    if manifest.credits is None:
        return (
            "The scene's spec names neither author nor licence ([credits]); ask who made the scene before sharing it."
        )
    lines = [f"- {key}: {value}" for key, value in manifest.credits.items() if value]
    return "\n".join([*lines, "\nThe licence is the scene's; photonfarm lays no claim to what it renders."])


def _format_table(columns: tuple[Column, ...]) -> str:
    shapes = [" × ".join(map(str, column.shape)) or "–" for column in columns]
    rows = [(f"`{c.name}`", c.dtype, shape, c.unit or "–", c.meaning) for c, shape in zip(columns, shapes, strict=True)]
    return format_markdown_table(("name", "type", "shape", "unit", "is"), rows)


def _format_origin(manifest: Manifest) -> str:
    about, camera = manifest.constants, manifest.constants["camera"]
    groups = ", ".join(about["groups"]) or "none: the scene is static"
    parts = [
        f"- scene id {manifest.scene.id}, store {manifest.store}",
        f"- committed jobs {manifest.jobs} of {len(manifest.plans)} plans, rows {manifest.rows} of the store",
        f"- half-estimates of {about['half_spp']} samples per pixel each; exposure {about['exposure']:g} for display",
        f"- {camera['width']} × {camera['height']} pixels, field of view {_describe_fov(camera)} along the width",
        f"- movable groups, in the order of `modification`: {groups}",
        f"- held out: a share {manifest.settings.hold_out:g} of the configurations, chosen by a hash of their content",
        "- versions and plans: export.json",
    ]
    return "\n".join(parts)


def _describe_fov(camera: dict[str, Any]) -> str:
    return "{min:g}° to {max:g}°".format_map(camera["fov"]) if "fov" in camera else f"{camera['fov_deg']:g}°"


CROISSANT = "croissant.json"

_TYPES = {"str": "sc:Text", "bool": "sc:Boolean", "int64": "sc:Integer"}

_TERMS = ("column", "dataType", "extract", "field", "fileSet", "includes", "isArray", "arrayShape", "isLiveDataset")
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    **{term: f"cr:{term}" for term in (*_TERMS, "key", "recordSet", "source")},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
}
"""The terms that are used here, of the context that the specification of Croissant 1.1 prints."""


def write_croissant(exported: Exported) -> None:
    """Write the Croissant metadata of tables: their files and columns, as JSON-LD for search engines and loaders."""
    columns, manifest = exported.contents.columns, exported.manifest
    said = manifest.credits or {}
    document = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": f"photonfarm-{manifest.scene.name}",
        "description": f"{manifest.samples} samples of the scene {manifest.scene.name}: pairs of independent unbiased "
        "noisy renders of views of it, with buffers.",
        "version": f"1.0.0+{manifest.samples}.samples",
        "license": said.get("licence", "unknown"),
        "creator": {"@type": "sc:Organization", "name": said.get("author", "unknown")},
        "url": said.get("source") or f"urn:photonfarm:scene:{manifest.scene.id}",
        "isLiveDataset": True,
        "distribution": [
            {
                "@type": "cr:FileSet",
                "@id": "tables",
                "encodingFormat": "application/x-parquet",
                "includes": f"{DATA}/*.parquet",
            },
        ],
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": "samples",
                "key": {"@id": "samples/row"},
                "field": [_describe_field(column) for column in columns],
            }
        ],
    }
    with store_errors("write the Croissant metadata", exported.folder):
        write_whole(exported.folder / CROISSANT, json.dumps(document, indent=1, ensure_ascii=False) + "\n")


def _describe_field(column: Column) -> dict[str, Any]:
    shape = {"isArray": True, "arrayShape": ",".join(map(str, column.shape))} if column.shape else {}
    unit = f" Unit: {column.unit}." if column.unit not in ("", "1") else ""
    return {
        "@type": "cr:Field",
        "@id": f"samples/{column.name}",
        "name": column.name,
        "description": f"{column.meaning}.{unit}",
        "dataType": _TYPES.get(column.dtype, f"cr:{column.dtype.title()}"),
        **shape,
        "source": {"fileSet": {"@id": "tables"}, "extract": {"column": column.name}},
    }
