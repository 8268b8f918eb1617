"""A reader made from docs/store-format.md alone reads a whole store, through zarr-python and through tensorstore."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import plain_reader
import pytest
import store_samples as samples

from photonfarm.core.keys import make_key, seed_of
from photonfarm.core.records import arrays_of
from photonfarm.plan.request import Request
from photonfarm.scene.view import Camera
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.format import schema
from photonfarm.store.model.withdrawal import withdraw

ROOT = Path(__file__).parents[4]
PLAIN_READER = Path(__file__).parents[2] / "plain_reader.py"


WIDE_ROWS = (1, 9)
Arrays = dict[str, np.ndarray[Any, Any]]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Three scenes.

    Of the first, two plans: jobs 0 to 2 and 3 to 5, of 8 rows each. Job 3 wants passes of views in jobs 0 to 2; job 4
    is not committed, and job 5 has no files. Rows 20 to 23 are unused. The second is static (G = 0) and without
    photons; the third looks straight up, its object turns, and its second plan was withdrawn.
    """
    store = Store(tmp_path_factory.mktemp("conformance") / "store", create=True)
    grown(store)
    static = samples.small_spec(objects=[], photons={"paths": 0})
    scene = store.scene(store.plan(static, Request(modifications=3), shard_rows=2).scene_id)
    samples.commit_all(scene)
    above = {"min": [0, 1, 0], "max": [0, 2, 0]}
    turning = [{**samples.ALWAYS["objects"][0], "turn": {"min": -90, "max": 90}}]
    upwards = samples.small_spec(
        name="up", objects=turning, view={"origin": {"min": [0, 0, 0], "max": [0, 0, 0]}, "look_at": above}
    )
    above_scene = store.scene(store.plan(upwards, Request(modifications=2)).scene_id)
    samples.commit_all(above_scene)
    above_scene.plan(Request(modifications=2, seed=1))
    withdraw(above_scene)
    return store


def grown(store: Store) -> SceneStore:
    spec = samples.small_spec(exposure=4.0)
    request = Request(modifications=5, views_per_modification=2, passes=2)
    scene = store.scene(store.plan(spec, request, shard_rows=8).scene_id)
    scene.plan(Request(modifications=5, views_per_modification=2, passes=4))
    scene.write_base(*samples.base())
    for job in range(5):
        given = samples.outputs(scene, job)
        for row in {*WIDE_ROWS} & given.radiance.keys():
            given.radiance[row][0, 0, 0, 0] = 1e9
        samples.commit(scene, job, given)
    (scene.folder / "committed/000000000004.json").unlink()
    return scene


@pytest.fixture(scope="module")
def read(store: Store, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Arrays]:
    """What the plain reader has read, by what it read it with."""
    return {by: plainly(store, by, tmp_path_factory.mktemp("read") / f"{by}.npz") for by in ("zarr", "tensorstore")}


def plainly(store: Store, by: str, out: Path) -> Arrays:
    command = [sys.executable, "-I", "-W", "error", str(PLAIN_READER), str(store.root), by, str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with np.load(out) as arrays:
        return dict(arrays)


def test_zarr_and_tensorstore_read_the_same_bytes_of_every_array(store: Store, read: dict[str, Arrays]) -> None:
    arrays = {path.parent for path in Path(store.root).rglob("zarr.json") if '"array"' in path.read_text()}
    assert {f"{store.root}/scenes/{name}" for name in read["zarr"] if "/samples/" not in name} == set(map(str, arrays))
    assert len(arrays) == 2 * (8 + 24) + 10 + (8 + 18) + 2 * (8 + 24)
    assert read["zarr"].keys() == read["tensorstore"].keys()
    for name, values in read["zarr"].items():
        other = read["tensorstore"][name]
        assert (values.dtype, values.shape) == (other.dtype, other.shape), name
        assert values.tobytes() == other.tobytes(), name


def test_it_finds_the_samples_that_photonfarm_finds_and_reads_the_same(store: Store, read: dict[str, Arrays]) -> None:
    """The plain reader has recomputed each sample's key, and each file's checksum as its marker tells it, by then."""
    for scene in store.scenes():
        reader = SceneReader(store.root, scene.scene_id)
        rows = reader.refresh().tolist()
        found = {int(name.split("/")[2]) for name in read["zarr"] if name.startswith(f"{scene.scene_id}/samples/")}
        assert found == set(rows)
        for row in rows:
            same(reader, row, {name: read["zarr"][f"{scene.scene_id}/samples/{row}/{name}"] for name in names(scene)})


def names(scene: SceneStore) -> list[str]:
    outputs = set(schema.output_arrays(scene.spec)) - {"radiance_wide"}
    return [*outputs, "modification", "view", "pass", "rays", "seeds", "densities", "changed"]


def same(reader: SceneReader, row: int, plain: Arrays) -> None:
    sample = reader.read(row, guides=True)
    assert sample.guides is not None
    expected = {"radiance": sample.radiance, "view": sample.view.vector, "modification": sample.modification.vector}
    expected |= arrays_of(sample.buffers) | arrays_of(sample.guides) | {"point_seen": sample.visibility.points}
    if reader.spec.photons.paths:
        expected |= {f"photon_{name}": values for name, values in arrays_of(reader.read_photons(row)).items()}
        expected["photon_seen"] = sample.visibility.photons
    for name, values in expected.items():
        np.testing.assert_array_equal(plain[name], values, err_msg=name)
    assert plain["pass"] == sample.pass_number
    assert plain["densities"].tolist() == [1, 1]
    moved, vector = zip("xyz", sample.modification.translation.reshape(-1), strict=False), sample.modification
    changed = [f"object {axis}" for axis, value in moved if value] + ["object present"] * (not vector.present.all())
    changed += ["object turn"] * bool(vector.turn.any())
    assert plain["changed"].tolist() == changed
    np.testing.assert_allclose(plain["rays"], Camera.of(sample.view, reader.spec).rays(), atol=1e-6)
    vectors = sample.modification.vector, sample.view.vector
    key = make_key("sample", reader.spec.radiance_id, *vectors, sample.pass_number)
    assert sample.key == key
    named = [(key, "half A"), (key, "half B"), (reader.modification_key(row), "photons")]
    assert plain["seeds"].tolist() == [seed_of(*purpose) for purpose in named]


def test_the_store_has_what_is_hard_to_read(store: Store, read: dict[str, Arrays]) -> None:
    """Otherwise the tests above would hold for an easier one."""
    first = samples.small_spec(exposure=4.0).scene_id
    arrays = {name.removeprefix(f"{first}/"): v for name, v in read["tensorstore"].items() if name.startswith(first)}
    unused = arrays["plans/000000/sample_modification"] == -1
    assert np.flatnonzero(unused).tolist() == [20, 21, 22, 23]
    assert np.isnan(arrays["plans/000000/radiance"][unused]).all()
    wide = ~np.isnan(arrays["plans/000000/radiance_wide"]).any(axis=(1, 2, 3, 4))
    assert tuple(np.flatnonzero(wide)) == WIDE_ROWS
    assert np.isnan(arrays["plans/000000/radiance"][wide]).all()
    assert arrays["samples/9/radiance"][0, 0, 0, 0] == np.float32(1e9)
    not_committed = slice(8, 16)  # of the second plan
    assert not np.isnan(arrays["plans/000001/radiance"][not_committed]).any()
    assert {int(name.split("/")[1]) for name in arrays if name.startswith("samples/")} == {*range(20), *range(24, 32)}
    assert (arrays["plans/000001/sample_view"][:8] < 24).all()
    static = samples.small_spec(objects=[], photons={"paths": 0}).scene_id
    assert read["tensorstore"][f"{static}/plans/000000/modification"].shape == (4, 0, 4)


@pytest.mark.parametrize("by", ["zarr", "tensorstore"])
@pytest.mark.parametrize("array", ["plans/000000/radiance", "plans/000000/sample_key", "plans/000000/direct"])
def test_a_flipped_bit_is_found_by_both(store: Store, tmp_path: Path, by: str, array: str) -> None:
    shutil.copytree(next(Path(store.root).glob(f"scenes/*/{array}")), tmp_path / array)
    file = next((tmp_path / array).glob("c.0*"))
    whole = file.read_bytes()
    file.write_bytes(whole[:30] + bytes([whole[30] ^ 1]) + whole[31:])
    with pytest.raises(ValueError, match=r"(?i)checksum|digest mismatch|blosc error"):
        plain_reader.READERS[by](tmp_path / array)


def test_the_example_of_the_page_reads_the_store(store: Store) -> None:
    section = (ROOT / "docs/store-format.md").read_text().partition("## An example")[2]
    code = section.split("```")[1].removeprefix("python\n")
    done = subprocess.run(
        [sys.executable, "-I", "-W", "error", "-c", code],
        cwd=Path(store.root).parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 28 + 3 + 2
    assert not any("nan" in line for line in lines)
    assert sum(float(line.split()[-2]) > 1e6 for line in lines) == len(WIDE_ROWS)
