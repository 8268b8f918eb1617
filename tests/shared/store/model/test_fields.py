"""The columns of stored vectors have names; a plan that has others is refused."""

import numpy as np
import pytest
import store_samples as samples
import zarr

from photonfarm.core.errors import CorruptError
from photonfarm.store import SceneStore
from photonfarm.store.format.metadata import seal

scene = samples.scene


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


def test_a_field_of_a_newer_program_is_refused(scene: SceneStore) -> None:
    plan = zarr.open_group(scene.folder / "plans/000000", mode="r+")
    plan["view"].update_attributes({"fields": [*plan["view"].attrs["fields"], {"name": "fov"}]})
    seal(scene.folder / "plans/000000")
    with pytest.raises(CorruptError, match=r"fov.*install a newer photonfarm"):
        SceneStore(scene.storage, scene.scene_id).plans()
