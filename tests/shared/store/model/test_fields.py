"""The columns of stored vectors have names, may be added, and are at rest where a plan lacks them."""

from typing import Any

import checked_store
import numpy as np
import pytest
import store_samples as samples
import zarr

from photonfarm.core.errors import CorruptError
from photonfarm.data import Scene
from photonfarm.plan.chosen import Chosen
from photonfarm.plan.request import Request
from photonfarm.scene.arrangement import Shot
from photonfarm.scene.modification import FIELDS, FURTHER, rebuild_surfaces, rest, sample_modification
from photonfarm.scene.view import AXES, Camera, sample_views
from photonfarm.store import SceneStore, Store
from photonfarm.store.format import declarations, schema
from photonfarm.store.format.metadata import seal
from photonfarm.store.read.find import Query, find_samples, find_start

scene = samples.scene
TURN = {"name": "turn", "unit": "degrees", "rest": 0.0, "zero": "as modelled"}
POWER = {"name": "power", "unit": "natural logarithm", "rest": -0.5, "zero": "as the scene states it"}


def test_a_plan_describes_its_vectors(scene: SceneStore) -> None:
    plan = zarr.open_group(scene.folder / "plans/000000", mode="r")
    groups, fields = plan["modification"].attrs["groups"], plan["modification"].attrs["fields"]
    assert groups == ["object"]
    assert [field["name"] for field in fields] == ["x", "y", "z", "present"]
    assert [field["name"] for field in plan["view"].attrs["fields"]][3:] == ["look_at_x", "look_at_y", "look_at_z"]
    (stored,) = scene.plans()
    for kind in ("modification", "view"):
        density = getattr(stored.rows, f"{kind}_density")
        unused = np.isnan(getattr(stored.rows, kind).reshape(len(density), -1)).all(axis=1)
        np.testing.assert_array_equal(density, np.where(unused, np.nan, 1).astype(np.float32))


def test_a_plan_that_lacks_a_field_has_it_at_rest(scene: SceneStore, monkeypatch: pytest.MonkeyPatch) -> None:
    before = scene.plans()[0].rows.modification
    fields = (*declarations.FIELDS["modification"], TURN, POWER)
    monkeypatch.setitem(declarations.FIELDS, "modification", fields)
    after = SceneStore(scene.storage, scene.scene_id).plans()[0].rows.modification
    np.testing.assert_array_equal(after[..., :4], before)
    unused = np.isnan(before[..., 0])
    np.testing.assert_array_equal(after[~unused][:, 4:], np.broadcast_to(np.float32([0, -0.5]), (np.sum(~unused), 2)))
    assert np.isnan(after[unused]).all()


def test_turns_and_light_are_stored_and_found(store: Store) -> None:
    """By their names, in every reader; a reader of four columns alone would find these first."""
    (block,) = samples.small_spec().model_dump(mode="json")["objects"]
    sky = {"name": "lamp", "shapes": ["ceiling-light"], "power": {"min": 0.5, "max": 2}, "colour": [[1, 0.5, 0.25]]}
    spec = samples.small_spec(objects=[{**block, "turn": {"min": -90, "max": 90}}], lights=[sky])
    request = Request(modifications=5, views_per_modification=2)
    scene = store.scene(store.plan(spec, request, shard_rows=4).scene_id)
    scene.write_base(*samples.base())
    samples.commit_all(scene)
    assert store.plan(spec, request, shard_rows=4).new == 0
    plan = zarr.open_group(scene.folder / "plans/000000", mode="r")
    names = [field["name"] for field in plan["modification"].attrs["fields"]]
    assert names == [*FIELDS, *FURTHER]
    assert [field["rest"] for field in plan["modification"].attrs["fields"]][4:] == [*FURTHER.values()]
    reader = samples.reader_of(scene)
    sample = reader.read(0)
    expected = sample_modification(reader.spec, 0, 0)
    np.testing.assert_array_equal(sample.modification.vector, expected.vector)
    assert expected.turn[0] != 0
    cloud, base = sample.point_cloud, reader.base()[1]
    np.testing.assert_array_equal(cloud.normal, rebuild_surfaces(base, expected)[0])
    assert (cloud.normal != base.normal).any()
    key = expected.key(scene.spec.radiance_id).hex()
    assert find_samples(store, [scene.scene_id], Query.of(like=key)).count == 2
    start = find_start(store.root, scene.scene_id, None, key)
    assert start is not None
    np.testing.assert_array_equal(start[0].vector, expected.vector)
    assert checked_store.checked(store).exit_code == 0
    dataset = Scene(store.root, scene.scene_id).torch(fields=["modification"])
    np.testing.assert_array_equal(dataset[0]["modification"], expected.vector)


def test_a_field_of_view_of_each_view_is_stored_and_found(store: Store) -> None:
    """Configurations and places are those of the spec without a range; each view has one more number."""
    view = samples.small_spec().view.model_dump() | {"fov_deg": 50, "fov": {"min": 40, "max": 80}}
    spec, request = samples.small_spec(**samples.ALWAYS, view=view), Request(modifications=4, views_per_modification=3)
    scene = store.scene(store.plan(spec, request, shard_rows=4).scene_id)
    scene.write_base(*samples.base())
    samples.commit_all(scene)
    plan = zarr.open_group(scene.folder / "plans/000000", mode="r")
    assert [field["name"] for field in plan["view"].attrs["fields"]] == [*AXES, "fov"]
    vectors = scene.plans()[0].rows.view[:12]
    assert (vectors.shape, len(np.unique(vectors[:, 6]))) == ((12, 7), 12)
    assert 40 <= vectors[:, 6].min() < 50 < 70 < vectors[:, 6].max() <= 80
    sample = samples.reader_of(scene).read(1)
    np.testing.assert_array_equal(sample.view.vector, vectors[1])
    focal = Camera.of(sample.view, spec).focal_px
    assert focal == pytest.approx(0.5 * spec.film.width / np.tan(np.radians(vectors[1, 6] / 2)))
    asked = Shot.of(fov=float(vectors[1, 6]))
    assert find_samples(store, [scene.scene_id], Query.of(asked=asked)).count == 1
    start = find_start(store.root, scene.scene_id, 1, None)
    assert start is not None
    np.testing.assert_array_equal(start[1].vector, vectors[1])
    assert store.plan(spec, Chosen.of(spec, *start), shard_rows=4).new == 0, "the same view comes of its names"
    dataset = Scene(store.root, scene.scene_id).torch(fields=["view", "world_to_camera"])
    np.testing.assert_array_equal(dataset[1]["view"], vectors[1])
    assert float(dataset[1]["focal_px"]) == pytest.approx(focal)
    assert checked_store.checked(store).exit_code == 0
    other = samples.small_spec(view=view | {"fov": {"min": 30, "max": 80}})
    same = sample_views(other, [b"0" * 16], 0, [0], rest(other).vector[None])[0]
    without = sample_views(samples.small_spec(), [b"0" * 16], 0, [0], rest(other).vector[None])[0]
    np.testing.assert_array_equal(same[:6], without)


def test_columns_are_found_by_name_in_any_order() -> None:
    known: Any = declarations.FIELDS["modification"]
    values = np.arange(8, dtype=np.float32).reshape(1, 2, 4)
    np.testing.assert_array_equal(
        schema.select_by_name(values[..., [3, 0, 2, 1]], ["present", "x", "z", "y"], known), values
    )


def test_a_field_of_a_newer_program_is_refused(scene: SceneStore) -> None:
    plan = zarr.open_group(scene.folder / "plans/000000", mode="r+")
    plan["view"].update_attributes({"fields": [*plan["view"].attrs["fields"], {"name": "aperture"}]})
    seal(scene.folder / "plans/000000")
    with pytest.raises(CorruptError, match="has the field aperture, which this program does not know"):
        SceneStore(scene.storage, scene.scene_id).plans()
