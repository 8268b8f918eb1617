"""Croissant metadata of tables: the files and columns of a dataset, as JSON-LD for search engines and loaders."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from photonfarm.core.errors import store_errors
from photonfarm.core.files import write_whole
from photonfarm.export.columns import Column
from photonfarm.export.folder import DATA
from photonfarm.export.manifest import Manifest

CROISSANT = "croissant.json"

_TYPES = {"str": "sc:Text", "bool": "sc:Boolean", "int64": "sc:Integer"}

_CONTEXT: dict[str, Any] = {
    "@language": "en", "@vocab": "https://schema.org/", "citeAs": "cr:citeAs", "column": "cr:column",
    "conformsTo": "dct:conformsTo", "cr": "http://mlcommons.org/croissant/", "data": {"@id": "cr:data",
    "@type": "@json"}, "dataType": {"@id": "cr:dataType", "@type": "@vocab"}, "dct": "http://purl.org/dc/terms/",
    "extract": "cr:extract", "field": "cr:field", "fileObject": "cr:fileObject", "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet", "format": "cr:format", "includes": "cr:includes", "isArray": "cr:isArray",
    "arrayShape": "cr:arrayShape", "isLiveDataset": "cr:isLiveDataset", "jsonPath": "cr:jsonPath", "key": "cr:key",
    "md5": "cr:md5", "parentField": "cr:parentField", "path": "cr:path", "recordSet": "cr:recordSet",
    "references": "cr:references", "regex": "cr:regex", "repeated": "cr:repeated", "replace": "cr:replace",
    "sc": "https://schema.org/", "separator": "cr:separator", "source": "cr:source", "subField": "cr:subField",
    "transform": "cr:transform", "rai": "http://mlcommons.org/croissant/RAI/", "equivalentProperty":
    "cr:equivalentProperty", "samplingRate": "cr:samplingRate", "examples": {"@id": "cr:examples", "@type": "@json"},
}  # fmt: skip
"""The context that the specification of Croissant 1.1 prints."""


def write_croissant(folder: Path, columns: Sequence[Column], manifest: Manifest) -> None:
    """Write the metadata of the tables in a folder."""
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
            {"@type": "cr:FileSet", "@id": "tables", "encodingFormat": "application/x-parquet",
             "includes": f"{DATA}/*.parquet"},
        ],
        "recordSet": [{"@type": "cr:RecordSet", "@id": "samples", "key": {"@id": "samples/row"},
                       "field": [_field(column) for column in columns]}],
    }  # fmt: skip
    with store_errors("write the Croissant metadata", folder):
        write_whole(folder / CROISSANT, json.dumps(document, indent=1, ensure_ascii=False) + "\n")


def _field(column: Column) -> dict[str, Any]:
    shape = {"isArray": True, "arrayShape": ",".join(map(str, column.shape))} if column.shape else {}
    unit = f" Unit: {column.unit}." if column.unit not in ("", "1") else ""
    return {
        "@type": "cr:Field", "@id": f"samples/{column.name}", "name": column.name,
        "description": f"{column.meaning}.{unit}", "dataType": _TYPES.get(column.dtype, f"cr:{column.dtype.title()}"),
        **shape, "source": {"fileSet": {"@id": "tables"}, "extract": {"column": column.name}},
    }  # fmt: skip
