"""docs/store-format.md, the arrays' own attributes and the code say the same; other versions are refused."""

import json
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import store_samples as samples
import zarr

from photonfarm.core.errors import CorruptError, StoreError
from photonfarm.core.records import LIT_POINTS, arrays_of
from photonfarm.plan.request import Request
from photonfarm.scene.spec import Emitters, GuideSpec
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.format import declarations, markers, schema
from photonfarm.store.format.metadata import seal
from photonfarm.store.io.local import LocalStorage

DOCUMENT = Path(__file__).parents[4] / "docs/store-format.md"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneStore:
    """Two jobs of 4 samples and 1; base and job 0 are there. Not to be changed."""
    store = Store(tmp_path_factory.mktemp("format") / "store", create=True)
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=5), shard_rows=4).scene_id)
    scene.write_base(*samples.base())
    samples.commit(scene, 0, samples.outputs(scene, 0))
    return scene


# ------------------------------------------------------------------------------------------------------ the document


def table(declared: Iterable[declarations.ArrayDeclaration], prefix: str = "") -> str:
    """The document's table of these arrays."""
    lines = ["| array | type | shape | axes | unit | convention |", "|---|---|---|---|---|---|"]
    for array in declared:
        shape = ", ".join(map(str, array.shape)) + ("," if len(array.shape) == 1 else "")
        cells = [f"`{prefix}{array.name}`", np.dtype(array.dtype).name, f"({shape})", ", ".join(array.axes)]
        lines.append("| " + " | ".join([*cells, array.unit, array.convention]) + " |")
    return "\n".join(lines)


BASE = "\n".join(
    table(declared, f"{group}/") if group == "geometry" else table(declared, f"{group}/").split("\n", 2)[2]
    for group, declared in declarations.BASE.items()
)
TABLES = {
    "inputs": table(declarations.PLAN_INPUTS),
    "outputs": table([array for array in declarations.OUTPUTS if array not in declarations.GUIDES]),
    "guides": table(declarations.GUIDES),
    "base": BASE,
}


@pytest.mark.parametrize("name", TABLES)
def test_the_documents_tables_are_those_of_the_schema(name: str) -> None:
    written = DOCUMENT.read_text().partition(f"<!-- {name} -->\n\n")[2].partition("\n\n")[0]
    assert written == TABLES[name], f"paste this below <!-- {name} -->:\n\n{TABLES[name]}"


def test_the_document_is_of_this_version_and_names_the_constants() -> None:
    text = DOCUMENT.read_text()
    assert text.startswith(f"# The store's format, version {declarations.VERSION}\n")
    assert json.dumps({**declarations.stamp(), "id": "…"}, ensure_ascii=False) in text
    assert f"One chunk is {schema.INPUT_ROWS_PER_CHUNK} rows" in text
    assert f"L is {LIT_POINTS}, or P if that is less" in text
    assert all(f"`guides.{setting}`" in text for setting in GuideSpec.model_fields)
    assert all(f"`emitters.{key}`" in text for key in Emitters.model_fields)


def test_every_array_is_stored_as_the_document_declares_it(scene: SceneStore) -> None:
    plan = scene.folder / "plans/000000"
    declared = {plan / array.name: array for array in (*declarations.PLAN_INPUTS, *declarations.OUTPUTS)}
    declared |= {
        scene.folder / "base" / group / a.name: a for group, arrays in declarations.BASE.items() for a in arrays
    }
    stored = {path.parent: json.loads(path.read_text()) for path in scene.folder.rglob("zarr.json")}
    arrays = {path for path, about in stored.items() if about["node_type"] == "array"}
    assert arrays == set(declared)
    for path in arrays:
        about, array = stored[path], declared[path]
        attributes = dict(about["attributes"])
        exponent = attributes.pop("radiance_exponent", None)
        assert (exponent is not None) == array.name.startswith("radiance")
        if array.name in declarations.FIELDS:
            assert attributes.pop("fields") == list(declarations.FIELDS[array.name])
        assert attributes.pop("groups", None) == (["object"] if array.name == "modification" else None)
        assert attributes == {"unit": array.unit, "convention": array.convention}
        assert about["data_type"] == np.dtype(array.dtype).name
        assert about["dimension_names"] == list(array.axes)
        assert len(about["shape"]) == len(array.shape)
        assert about["chunk_key_encoding"] == {"name": "default", "configuration": {"separator": "."}}
        rows = {"R": 8, "P": 3, "V": 3, "F": 1, "S": 1}[str(array.shape[0])]
        lengths = {"G": 1, "C": 4, "D": 6, "H": 8, "W": 8, "K": 8, "L": 16, "⌈P/8⌉": 2, "⌈K/8⌉": 1}
        inner = [n if isinstance(n, int) else lengths[n] for n in array.shape[1:]]
        assert about["shape"] == [rows, *inner]
        is_output = array in declarations.OUTPUTS
        assert about["chunk_grid"]["configuration"]["chunk_shape"] == [4 if is_output else rows, *inner]


def test_every_chain_of_codecs_is_the_documents(scene: SceneStore) -> None:
    example = json.loads(re.findall(r"```json\n(\[.*?\])\n```", DOCUMENT.read_text(), re.S)[0])
    for path in scene.folder.rglob("zarr.json"):
        about = json.loads(path.read_text())
        if about["node_type"] != "array":
            continue
        size = np.dtype(about["data_type"]).itemsize
        to_bytes = example[0] if size > 1 else {"name": "bytes"}
        blosc = {"name": "blosc", "configuration": {**example[1]["configuration"], "typesize": size}}
        chain = [to_bytes, example[2]] if path.parent.name.startswith("radiance") else [to_bytes, blosc, example[2]]
        (codec, *more) = about["codecs"]
        if codec["name"] != "sharding_indexed":
            assert [codec, *more] == chain
            continue
        sharding = codec["configuration"]
        assert sharding["codecs"] == chain
        assert sharding["index_codecs"] == [example[0], example[2]]
        assert sharding["index_location"] == "end"
        assert sharding["chunk_shape"] == [1, *about["shape"][1:]]


def test_the_store_and_every_group_state_format_and_version(scene: SceneStore) -> None:
    documents = [json.loads(path.read_text()) for path in scene.folder.rglob("zarr.json")]
    groups = [about["attributes"] for about in documents if about["node_type"] == "group"]
    assert len(groups) == 4
    for stated in [*groups, json.loads(scene.storage.read("photonfarm.json"))]:
        assert (stated["format"], stated["version"]) == ("photonfarm store", 5)


def test_each_store_has_an_id_of_its_own_which_it_keeps(store: Store, tmp_path: Path) -> None:
    (stated,) = {json.loads(Path(store.root, "photonfarm.json").read_text())["id"]}
    assert re.fullmatch("[0-9a-f]{32}", stated)
    assert Store(store.root, create=True).store_id == store.store_id == stated
    assert Store(tmp_path / "another", create=True).store_id != stated


@pytest.mark.parametrize("store_id", [None, 7, "", "0" * 31, "A" * 32])
def test_a_store_without_an_id_is_corrupt(store: Store, store_id: object) -> None:
    change(Path(store.root, "photonfarm.json"), id=store_id)
    with pytest.raises(CorruptError):
        Store(store.root)


def test_a_store_that_is_gone_or_another_one_is_told_from_the_one_that_was_opened(store: Store) -> None:
    store.check()
    root = Path(store.root)
    root.rename(root.with_name("away"))
    with pytest.raises(StoreError):
        store.check()
    other = Store(root, create=True)
    with pytest.raises(StoreError, match=str(other.store_id)):
        store.check()


# ---------------------------------------------------------------------------------------------------------- versions


@pytest.mark.parametrize(
    ("stated", "advice"),
    [
        ({"format": "photonfarm store", "version": 4}, "older photonfarm"),
        ({"format": "photonfarm store", "version": 6}, "newer photonfarm"),
        ({"format": "photonfarm store", "version": 10**30}, "newer photonfarm"),
        ({"format": "photonfarm store", "version": 0}, r"Restore photonfarm\.json"),
        ({"format": "photonfarm store", "version": "5"}, r"Restore photonfarm\.json"),
        ({"format": "photonfarm store", "version": 5.0}, r"Restore photonfarm\.json"),
        ({"format": "photonfarm store", "version": True}, r"Restore photonfarm\.json"),
        ({"format": "photonfarm store", "version": None}, r"Restore photonfarm\.json"),
        ({"format": "someone's store", "version": 5}, "Give the folder of a photonfarm store"),
        ({"format": None, "version": 5}, "Give the folder of a photonfarm store"),
    ],
)
def test_another_version_is_refused_by_all_who_open_a_store(store: Store, stated: dict[str, Any], advice: str) -> None:
    scene = store.add(samples.small_spec())
    Path(store.root, "photonfarm.json").write_text(json.dumps(stated))
    before = {path: path.read_bytes() for path in Path(store.root).rglob("*") if path.is_file()}
    for look in (
        lambda: Store(store.root),
        lambda: Store(store.root, create=True),
        SceneReader(store.root, scene.scene_id).refresh,
    ):
        with pytest.raises(StoreError, match=advice):
            look()
    assert {path: path.read_bytes() for path in Path(store.root).rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("content", ["", "{", "[]", "2", "{}", '{"format": "photonfarm store"}', "\xff"])
def test_a_format_document_that_is_none_is_corrupt(store: Store, content: str) -> None:
    Path(store.root, "photonfarm.json").write_text(content, encoding="latin-1")
    with pytest.raises(CorruptError):
        Store(store.root)


# ---------------------------------------------------------------------------------------------------------- additions


def change(path: Path, **additions: Any) -> None:
    """Add keys to a JSON document."""
    path.write_text(json.dumps({**json.loads(path.read_text()), **additions}))


def add_everywhere(scene: SceneStore) -> None:
    """Files, folders, arrays, attributes and keys that this version does not know, wherever there may be some."""
    root, plan = scene.folder.parents[1], scene.folder / "plans/000000"
    for folder in (root, root / "scenes", scene.folder, scene.folder / "plans", plan, scene.folder / "committed"):
        for name in ("notes.txt", "notes.json", ".hidden"):
            (folder / name).write_text("someone's")
        (folder / "more").mkdir()
        (folder / "more" / "zarr.json").write_text("{}")
    (scene.folder / "committed/1.json").write_text("{}")
    (scene.folder / "committed/000000000001.json.bak").write_text("{}")
    change(root / "photonfarm.json", made_by="another")
    marker_file = scene.folder / "committed/000000000000.json"
    marker = json.loads(marker_file.read_text())
    marker["figures"]["joules"] = 3
    marker["files"]["plans/000000/variance/c.0.0"] = {"size": 3, "crc32c": "00000000", "storage": "cold"}
    marker_file.write_text(json.dumps({**marker, "signature": "…"}))
    base = scene.folder / "base"
    for path in (plan, plan / "radiance", base, base / "cloud/position"):
        about = json.loads((path / "zarr.json").read_text())
        change(path / "zarr.json", attributes={**about["attributes"], "colour": "green", "codec": {"a": 1}})
    about = json.loads((plan / "zarr.json").read_text())
    about["attributes"]["request"]["tilt"] = 3
    (plan / "zarr.json").write_text(json.dumps(about))
    for path in (plan, base, base / "cloud"):
        group = zarr.open_group(str(path), mode="r+")
        group.create_array("variance", data=np.ones((3, 2)))
        group.create_group("appendix")
    for path in (plan, base):
        seal(path)


def test_unknown_files_arrays_attributes_and_keys_are_ignored(scene: SceneStore, tmp_path: Path) -> None:
    shutil.copytree(scene.folder.parents[1], tmp_path / "store")
    store = Store(tmp_path / "store")
    add_everywhere(store.scene(scene.scene_id))
    opened = Store(store.root, create=True)
    assert opened.scene_ids() == [scene.scene_id]
    again = opened.scene(scene.scene_id)
    assert (again.jobs(), again.committed_jobs(), again.missing_jobs()) == (2, {0}, [1])
    assert again.marker(0)["signature"] == "…"
    assert read_all(again) == read_all(scene)
    samples.commit_all(again)
    assert again.progress().committed_samples == 5
    assert again.plan(Request(modifications=6)).plan == 1
    assert samples.statuses(opened)[0].samples_planned == 6


def read_all(scene: SceneStore) -> list[bytes]:
    """Something of every kind that a reader reads, as bytes."""
    reader = SceneReader(scene.folder.parents[1], scene.scene_id)
    found = []
    for row in reader.refresh().tolist():
        sample = reader.read(row, guides=True)
        found += [sample.radiance.tobytes(), reader.read_photons(row).power.tobytes()]
        found += [values.tobytes() for values in arrays_of(sample.guides).values()]
    geometry, cloud = reader.base()
    return [*found, geometry.vertices.tobytes(), cloud.position.tobytes()]


# ------------------------------------------------------------------------------------------------------------ markers

SHARD = "plans/000000/depth/c.0.0.0"
FILE = {"size": 3, "crc32c": "00ff00ff"}
FIGURES = {"core_s": 1.0, "wall_s": 1, "redrawn": 0, "worker": "ada", "versions": {}}


def marker_with(**changes: Any) -> dict[str, Any]:
    return {"job": 0, "files": {SHARD: FILE}, "figures": FIGURES, **changes}


def test_a_marker_reads_as_it_is_written(scene: SceneStore) -> None:
    assert scene.marker(0) == json.loads((scene.folder / "committed/000000000000.json").read_text())


def test_a_marker_as_the_document_shows_it_is_read(tmp_path: Path) -> None:
    (example,) = re.findall(r"```json\n(\{.*?\})\n```", DOCUMENT.read_text(), re.S)
    assert read_marker(tmp_path, example) == json.loads(example)


def read_marker(root: Path, content: str | bytes) -> dict[str, Any]:
    """The marker of job 0 of scene s with this content."""
    (root / "scenes/s/committed").mkdir(parents=True)
    (root / "scenes/s/committed/000000000000.json").write_bytes(
        content.encode() if isinstance(content, str) else content
    )
    return markers.read_marker(LocalStorage(root), "scenes/s", 0)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("", ""),
        ('{"job": 0, "fi', ""),
        ("[" * 100_000, ""),
        (b"\xff\xfe\x00garbage", ""),
        ("[]", ""),
        ("null", ""),
        ({}, "job: .*; files: .*; figures: "),
        (marker_with(job=1), "job = 1"),
        (marker_with(job=-1), "job = -1"),
        (marker_with(job="0"), "job = '0'"),
        (marker_with(files={}), "files = {}"),
        (marker_with(files=[]), r"files = \[\]"),
        (marker_with(files={SHARD: {**FILE, "size": -3}}), "size = -3"),
        (marker_with(files={SHARD: {**FILE, "size": 3.5}}), r"size = 3\.5"),
        (marker_with(files={SHARD: {"size": 3}}), "crc32c: "),
        (marker_with(files={SHARD: {**FILE, "crc32c": "00FF00FF"}}), "crc32c = '00FF00FF'"),
        (marker_with(files={SHARD: {**FILE, "crc32c": "00ff00ff\n"}}), "crc32c = "),
        (marker_with(files={"../../photonfarm.json": FILE}), r"= '\.\./\.\./photonfarm\.json'"),
        (marker_with(files={"/etc/passwd": FILE}), "= '/etc/passwd'"),
        (marker_with(files={"plans/000000/../c.0": FILE}), r"= 'plans/000000/\.\./c\.0'"),
        (marker_with(figures={**FIGURES, "core_s": -1}), r"figures\.core_s = -1"),
        (marker_with(figures={**FIGURES, "wall_s": float("nan")}), r"figures\.wall_s = nan"),
        (marker_with(figures={**FIGURES, "wall_s": float("inf")}), r"figures\.wall_s = inf"),
        (marker_with(figures={**FIGURES, "redrawn": "1"}), r"figures\.redrawn = '1'"),
        (marker_with(figures={**FIGURES, "versions": {"numpy": 2}}), r"figures\.versions\.numpy = 2"),
        (marker_with(figures=None), "figures = None"),
    ],
)
def test_a_marker_that_is_none_is_corrupt_and_the_error_names_file_and_key(
    tmp_path: Path, content: Any, named: str
) -> None:
    with pytest.raises(CorruptError, match=rf"committed/000000000000\.json.*{named}"):
        read_marker(tmp_path, content if isinstance(content, str | bytes) else json.dumps(content))


def test_a_marker_that_is_not_there_is_a_store_error(scene: SceneStore) -> None:
    with pytest.raises(StoreError):
        scene.marker(1)


def test_only_names_of_twelve_digits_are_markers(tmp_path: Path) -> None:
    folder = tmp_path / "scenes/s/committed"
    folder.mkdir(parents=True)
    names = (
        "000000000007.json",
        "7.json",
        "notes.json",
        "0000000000070.json",
        "000000000008.json.bak",
        "٠٠٠٠٠٠٠٠٠٠٠٩.json",
    )
    for name in names:
        (folder / name).write_text("{}")
    assert markers.list_jobs(LocalStorage(tmp_path), "scenes/s") == {7}
