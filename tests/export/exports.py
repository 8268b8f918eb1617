"""Scenes to export, exports of them, and what other libraries read in these."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import store_samples as samples
from pyarrow import parquet

from photonfarm.export.export import Result, export_scene
from photonfarm.export.folder import ExportRequest
from photonfarm.plan.request import Request
from photonfarm.store import SceneStore, Store

FORMATS = ("webdataset", "exr", "npz", "parquet")
BRIGHT = 3  # a row whose radiance float16 cannot hold


def planned(place: str | Path, *, views: int = 1, modifications: int = 10, **changes: Any) -> SceneStore:
    """A scene with jobs of 2 samples, and its base."""
    store = Store(place, create=True)
    request = Request(modifications=modifications, views_per_modification=views)
    scene = store.scene(store.plan(samples.small_spec(**changes), request, shard_rows=2).scene_id)
    scene.write_base(*samples.base())
    return scene


def commit(scene: SceneStore, job: int) -> None:
    given = samples.outputs(scene, job)
    if BRIGHT in given.radiance:
        given.radiance[BRIGHT] *= np.float32(1e6 / 3)
    samples.commit(scene, job, given)


def exported(scene: SceneStore, out: Path, to: str, on_progress: Any = lambda *_: None, **asked: Any) -> Result:
    store = scene.folder.parent.parent
    return export_scene(store, scene.scene_id, out, ExportRequest(to=to, **asked), lambda _: None, on_progress)  # type: ignore[arg-type]


def several(to: str, number: int = 3) -> dict[str, int]:
    """The option for small files, of the formats that have it."""
    return {"samples_per_file": number} if to in ("webdataset", "parquet") else {}


def read(folder: Path, to: str) -> dict[int, dict[str, Any]]:
    """The arrays and the facts of every sample in an export, by row."""
    found = {"webdataset": tar_samples, "exr": exr_samples, "npz": npz_samples, "parquet": table_samples}[to](folder)
    by_row = {int(sample["row"]): sample for sample in found}
    assert len(by_row) == len(found)
    return by_row


def tar_samples(folder: Path) -> list[dict[str, Any]]:
    import webdataset

    shards = sorted(map(str, folder.glob("data/*.tar")))
    found = []
    for sample in webdataset.WebDataset(shards, shardshuffle=False).decode():
        arrays = {name.removesuffix(".npy"): value for name, value in sample.items() if name.endswith(".npy")}
        halves = {"A": arrays.pop("a"), "B": arrays.pop("b")}
        assert int(sample["__key__"]) == sample["json"]["row"]
        found.append({**arrays, **halves, **sample["json"]})
    return found


def exr_samples(folder: Path) -> list[dict[str, Any]]:
    found = []
    for file in sorted(folder.glob("samples/*.exr")):
        with OpenEXR.File(str(file)) as image:
            layers = {name: channel.pixels for name, channel in image.channels().items()}
            facts = json.loads(image.header()["photonfarm"])
        arrays = {name: values for name, values in layers.items() if "." not in name}
        arrays |= {name.partition(".")[0]: values for name, values in layers.items() if name[-2:] in (".V", ".Z")}
        for name in {name.partition(".")[0] for name in layers if name.endswith(".X")}:
            arrays[name] = np.stack([layers[f"{name}.{axis}"] for axis in "XYZ"], axis=-1)
        np.testing.assert_array_equal(arrays.pop("RGB"), (arrays["A"] + arrays["B"]) / np.float32(2))
        if file.with_suffix(".npz").exists():
            with np.load(file.with_suffix(".npz")) as beside:
                arrays |= dict(beside)
        found.append({**arrays, **facts})
    return found


def npz_samples(folder: Path) -> list[dict[str, Any]]:
    found = []
    for file in sorted(folder.glob("samples/*.npz")):
        with np.load(file, allow_pickle=False) as archive:
            found.append({name: values if values.shape else values.item() for name, values in archive.items()})
    return found


def table_samples(folder: Path) -> list[dict[str, Any]]:
    found = []
    for file in sorted(folder.glob("data/*.parquet")):
        found += parquet.read_table(file).to_pylist()
    return found
