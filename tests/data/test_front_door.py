"""`photonfarm.data`: a scene of a store in a folder or a bucket, from the first five lines to two spawned processes.

And the public names of all four packages.
"""

import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from inspect import Signature, signature
from pathlib import Path
from types import ModuleType

import bucket_samples
import numpy as np
import pytest
import store_samples as samples
import torch

import photonfarm.data
import photonfarm.predict
import photonfarm.renderer
import photonfarm.trainer
from photonfarm.core.errors import SpecError, StoreError
from photonfarm.core.keys import seed_of
from photonfarm.core.records import arrays_of
from photonfarm.data import Scene, open_scene
from photonfarm.plan.hold_out import are_held_out
from photonfarm.store import SceneStore, Store
from photonfarm.store.format.shards import NOISY_GUIDES, round_to_8_bits
from photonfarm.store.read.find import Query, find_samples


@pytest.fixture(params=["folder", "bucket"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str | Path:
    return request.getfixturevalue("url") if request.param == "bucket" else tmp_path / "store"


def stored(place: str | Path, *, views: int = 1) -> SceneStore:
    """A scene of 10 configurations, all committed."""
    scene = bucket_samples.planned(place, modifications=10, views_per_modification=views)
    samples.commit_all(scene)
    scene.write_base(*samples.base())
    return scene


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    stored(tmp_path / "store")
    return open_scene(tmp_path / "store", "small")


@pytest.mark.parametrize(
    ("package", "names"),
    [
        (photonfarm.data, ["PointCloud", "Sample", "Scene", "open_scene"]),
        (photonfarm.predict, ["open_run"]),
        (photonfarm.renderer, ["load_mitsuba"]),
        (photonfarm.trainer, ["train"]),
    ],
)
def test_public_names(package: ModuleType, names: list[str]) -> None:
    assert sorted(package.__all__) == names
    assert all(callable(getattr(package, name)) for name in names)


@pytest.mark.parametrize(
    ("function", "parameters"),
    [
        (photonfarm.data.open_scene, "store, scene, *, guides=True"),
        (photonfarm.predict.open_run, "run, store='store', device='auto', *, fov=None"),
        (photonfarm.renderer.load_mitsuba, "threads=None"),
        (
            photonfarm.trainer.train,
            "store, scene, run, *, preset=None, redis_url=None, log=<built-in function print>, **settings",
        ),
    ],
)
def test_public_parameters(function: Callable[..., object], parameters: str) -> None:
    found = [one.replace(annotation=one.empty) for one in signature(function).parameters.values()]
    assert str(Signature(found)) == f"({parameters})"


def test_public_members() -> None:
    assert {name for name in dir(Scene) if not name.startswith("_")} == {
        "geometry",
        "has_guides",
        "id",
        "name",
        "read_samples",
        "refresh",
        "row",
        "rows",
        "snapshot",
        "spec",
        "split",
        "torch",
    }
    members = {*dir(photonfarm.data.Sample), *(field.name for field in fields(photonfarm.data.Sample))}
    assert {name for name in members if not name.startswith("_")} == {
        "buffers",
        "decoded",
        "guides",
        "images",
        "key",
        "modification",
        "pass_number",
        "photons",
        "point_cloud",
        "radiance",
        "read_cloud",
        "read_photons",
        "row",
        "scale",
        "seeds",
        "seen_photons",
        "view",
        "visibility",
    }


def test_a_sample_is_what_was_committed(place: str | Path) -> None:
    written = stored(place)
    scene = open_scene(place, written.scene_id[:8])
    assert (scene.name, scene.id, len(scene)) == ("small", written.scene_id, 10)
    committed = samples.outputs(written, 3)
    for row in written.job_rows(3).samples:
        sample, photons = scene[row.row], samples.photons(written.spec, row.modification_row)
        np.testing.assert_array_equal(sample.radiance, committed.radiance[row.row])
        np.testing.assert_array_equal(sample.albedo, committed.buffers[row.view_row].albedo)
        np.testing.assert_array_equal(sample.photons.power, photons.power)
    sample = scene[-1]
    assert sample.row == 9
    assert len(set(sample.seeds)) == 2
    assert sample.point_cloud.position.shape == (3, 3)
    moved = sample.modification.translation[0] * sample.modification.present[0]
    np.testing.assert_allclose(sample.point_cloud.position[1:], np.eye(3)[1:] + moved, rtol=1e-6)


def test_a_key_is_the_one_by_which_the_store_finds_the_sample(scene: Scene, tmp_path: Path) -> None:
    sample = scene[4]
    (found,) = find_samples(Store(tmp_path / "store"), [scene.id], Query(sample=sample.key)).samples
    assert (found.row, found.key) == (4, sample.key.hex())
    assert sample.seeds == (seed_of(sample.key, "half A"), seed_of(sample.key, "half B"))


@pytest.mark.parametrize("workers", [2])
def test_five_lines_with_a_loader_of_spawned_processes(place: str | Path, workers: int) -> None:
    stored(place)
    scene = open_scene(place, "small")
    dataset = scene.torch(split="train")
    context = "spawn" if workers else None
    loader = torch.utils.data.DataLoader(dataset, batch_size=4, num_workers=workers, multiprocessing_context=context)
    rows = []
    for batch in loader:
        assert batch["radiance"].shape[1:] == (2, 8, 8, 3)
        assert batch["modification"].shape[1:] == (1, 4)
        assert batch["view"].shape[1:] == (6,)
        assert batch["pass_number"].tolist() == [scene.row(row).pass_number for row in batch["row"].tolist()]
        for row, radiance in zip(batch["row"].tolist(), batch["radiance"], strict=True):
            np.testing.assert_array_equal(radiance, samples.values(row, (2, 8, 8, 3)))
            rows.append(row)
    assert rows == scene.split("train").rows.tolist()


def test_what_is_held_out_is_what_training_holds_out(scene: Scene) -> None:
    train, held_out = (scene.split(split, hold_out=0.4) for split in ("train", "held-out"))
    assert sorted([*train.rows, *held_out.rows]) == scene.rows.tolist()
    keys = [sample.modification.key(scene.spec.radiance_id) for sample in held_out]
    assert keys
    assert all(are_held_out(keys, 0.4))
    with pytest.raises(ValueError, match="held-out"):
        scene.split("test")  # type: ignore[arg-type]
    for share in (-0.5, 0, 1, 12.5):
        with pytest.raises(ValueError, match="hold_out"):
            scene.split("train", hold_out=share)


def test_a_sample_is_had_by_its_row_and_never_searched_for(scene: Scene) -> None:
    train = scene.split("train", hold_out=0.4)
    (row, *_), (held_out, *_) = train.rows.tolist(), scene.split("held-out", hold_out=0.4).rows
    assert train.row(row).row == row
    for missing in (held_out, -1, 10):
        with pytest.raises(LookupError, match=f"row {missing} .* {len(train)} complete samples"):
            train.row(missing)
    with pytest.raises(LookupError, match="0 complete samples"):
        Scene(scene._store, scene.id, rows=[]).row(3)
    with pytest.raises(TypeError):
        train[0] in train  # noqa: B015


def test_a_scene_grows_and_a_snapshot_does_not(tmp_path: Path) -> None:
    written = bucket_samples.planned(tmp_path / "store", modifications=10)
    written.write_base(*samples.base())
    scene = open_scene(tmp_path / "store", "small")
    assert len(scene) == 0
    samples.commit(written, 0, samples.outputs(written, 0))
    snapshot = scene.snapshot()
    assert scene.refresh() == 2
    assert (len(scene), len(snapshot)) == (2, 0)
    later = pickle.loads(pickle.dumps(scene.snapshot()))
    samples.commit(written, 1, samples.outputs(written, 1))
    assert later.rows.tolist() == [0, 1]
    with pytest.raises(ValueError, match="change"):
        later.refresh()
    assert scene.refresh() == 2
    assert [sample.row for sample in scene[1:3]] == [1, 2]
    with pytest.raises(IndexError):
        scene[4]


def test_guides_come_with_samples_unless_the_scene_is_opened_without(tmp_path: Path) -> None:
    written = stored(tmp_path / "store", views=2)
    scene, without = (open_scene(tmp_path / "store", "small", guides=guides) for guides in (True, False))
    assert scene.rows.tolist() == without.rows.tolist()
    for row in (4, 5):
        sample = scene[row]
        for name, values in arrays_of(samples.guides(written.spec, row)).items():
            np.testing.assert_array_equal(
                getattr(sample, name), round_to_8_bits(values) if name in NOISY_GUIDES else values
            )
            np.testing.assert_array_equal(getattr(sample, name), getattr(sample.guides, name))
    assert scene.torch()[5]["direct"].shape == (8, 8, 3)
    assert without[5].guides is None
    assert (scene.has_guides, without.has_guides) == (True, False)
    assert "direct" not in without.torch()[5]
    with pytest.raises(AttributeError):
        _ = without[5].direct


def test_wrong_names_raise_with_those_that_exist(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=rf"{scene.id} \(small\)"):
        open_scene(tmp_path / "store", "large")
    with pytest.raises(StoreError):
        open_scene(tmp_path / "nowhere", "small")
    with pytest.raises(AttributeError, match="albedo"):
        _ = scene[0].albdo
    with pytest.raises(SpecError, match="albedo"):
        scene.torch(fields=["albdo"])


@pytest.mark.parametrize("fields", [["depth"], ["radiance"], ["modification"], ["radiance", "direct", "view"]])
def test_any_fields_alone_are_had_as_tensors(scene: Scene, fields: list[str]) -> None:
    assert set(scene.torch(fields=fields)[0]) == {"row", "pass_number", *fields}


def test_reading_needs_neither_torch_nor_mitsuba(scene: Scene, tmp_path: Path) -> None:
    code = "import sys; from photonfarm.data import open_scene; open_scene(sys.argv[1], 'small')[0].radiance; "
    code += "sys.exit(any(name in sys.modules for name in ('torch', 'mitsuba')))"
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path / "store")]).returncode == 0
