"""zarr-python, without any code of ours, reads what we wrote; it is the judge of the format."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import store_samples as samples
import zarr

from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, SceneStore, Store


@pytest.fixture
def scene(tmp_path: Path) -> SceneStore:
    store = Store(tmp_path / "store", create=True)
    request = Request(modifications=5, views_per_modification=2, passes=2)
    scene = store.scene(store.plan(samples.small_spec(exposure=4.0), request, shard_rows=8).scene_id)
    for job in scene.missing_jobs():
        given = samples.outputs(scene, job)
        if job == 1:
            given.radiance[9][0, 0, 0, 0] = 1e9
        samples.commit(scene, job, given)
    scene.write_base(*samples.base())
    return scene


def test_plain_zarr_in_a_process_without_photonfarm_reads_the_same_samples(scene: SceneStore, tmp_path: Path) -> None:
    code = """
import json, sys, numpy, zarr
plan = zarr.open_group(sys.argv[1], mode="r")
rows = numpy.flatnonzero(plan["sample_modification"][:] >= 0)
radiance = plan["radiance"][:].astype("f4") * 2.0 ** -plan["radiance"].attrs["radiance_exponent"]
wide = plan["radiance_wide"][:]
radiance = numpy.where(numpy.isnan(radiance), wide, radiance)
view = plan["sample_view"][:][rows]
numpy.savez(sys.argv[2], rows=rows, radiance=radiance[rows], depth=plan["depth"][:][view],
            normal=plan["normal"][:][view], power=plan["photon_power"][:][plan["sample_modification"][:][rows]])
assert not [name for name in sys.modules if name.startswith("photonfarm")]
"""
    out = tmp_path / "read.npz"
    subprocess.run([sys.executable, "-c", code, str(scene.folder / "plans/000000"), str(out)], check=True, cwd=tmp_path)
    read = np.load(out)
    reader = SceneReader(scene.folder.parent.parent, scene.scene_id)
    assert reader.refresh().tolist() == read["rows"].tolist() == list(range(20))
    for i, row in enumerate(read["rows"].tolist()):
        sample = reader.read(row)
        np.testing.assert_array_equal(read["radiance"][i], sample.radiance)
        np.testing.assert_array_equal(read["depth"][i], sample.buffers.depth)
        np.testing.assert_array_equal(read["normal"][i], sample.buffers.normal)
        np.testing.assert_array_equal(read["power"][i], reader.read_photons(row).power)


def test_every_array_is_zarr_3_with_a_checksum_last_and_says_what_it_holds(scene: SceneStore) -> None:
    documents = [json.loads(p.read_text()) for p in (scene.folder).rglob("zarr.json")]
    arrays = [d for d in documents if d["node_type"] == "array"]
    assert len(arrays) == 8 + 24 + 10
    for array in arrays:
        codecs = array["codecs"]
        if codecs[0]["name"] == "sharding_indexed":
            assert codecs[0]["configuration"]["index_codecs"][-1]["name"] == "crc32c"
            codecs = codecs[0]["configuration"]["codecs"]
        assert codecs[-1]["name"] == "crc32c"
        assert array["attributes"]["convention"]
        assert len(array["dimension_names"]) == len(array["shape"])
    assert not any("consolidated_metadata" in d for d in documents)


def test_noise_is_stored_raw_and_all_else_behind_a_byte_shuffle(scene: SceneStore) -> None:
    plan = zarr.open_group(str(scene.folder / "plans/000000"), mode="r")
    assert [type(c).__name__ for c in plan["radiance"].compressors] == ["Crc32cCodec"]
    depth = plan["depth"].compressors[0]
    assert (depth.cname.value, depth.shuffle.value) == ("lz4", "shuffle")
    assert plan["radiance"].dtype == np.float16
    assert (plan["depth"].dtype, plan["photon_bounce"].dtype) == (np.float32, np.int8)


def test_rows_that_are_not_used_are_not_on_disk_and_read_as_nan(scene: SceneStore) -> None:
    plan = zarr.open_group(str(scene.folder / "plans/000000"), mode="r")
    used = set(range(20))
    assert plan["radiance"].shape[0] == 24
    assert np.isnan(plan["radiance"][20:]).all()
    assert not np.isnan(plan["radiance"][sorted(used - {9})]).any()
    assert np.isnan(plan["radiance"][9]).all()
    assert not np.isnan(plan["radiance_wide"][9]).any()
    size = (scene.folder / "plans/000000/radiance/c.2.0.0.0.0").stat().st_size
    assert size == 4 * (2 * 8 * 8 * 3 * 2 + 4) + 8 * 16 + 4
