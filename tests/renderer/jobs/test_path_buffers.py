"""`photonfarm buffers`: the same numbers as in the store, for views that are in no store."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import IncompleteError, SpecError, StoreError
from photonfarm.core.records import arrays_of
from photonfarm.plan.request import Request
from photonfarm.renderer.jobs.path_buffers import find_views, frames_of
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.arrangement import Arrangement
from photonfarm.scene.camera_path import CameraPath, Frames
from photonfarm.scene.modification import rest, sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import SceneReader, Store
from photonfarm.store.format.schema import output_arrays
from photonfarm.store.format.shards import NOISY_GUIDES, round_to_8_bits


@pytest.fixture
def spec(small: Callable[..., SceneSpec]) -> SceneSpec:
    return small(load_spec("room"))


def test_what_views_show_is_what_the_store_has_of_the_same_views(tmp_path: Path, spec: SceneSpec) -> None:
    """The store rounds it to the types that it declares. Each view is of a job of its own, and the first has traced
    the photons that the second sees.
    """
    store = Store(tmp_path / "store", create=True)
    scene_id = store.plan(spec, Request(modifications=1, views_per_modification=2), shard_rows=1).scene_id
    for job in (1, 0):
        ShardRenderer(store, worker="test").render(scene_id, job)
    reader = SceneReader(store.root, scene_id)
    samples = [reader.read(int(row), guides=True) for row in reader.refresh()]
    frames = frames_of(spec, samples[0].modification, [sample.view for sample in samples])
    assert frames.scene_id == scene_id
    arrays = output_arrays(spec)
    for place, sample in enumerate(samples):
        for name, stored in arrays_of(sample.visibility).items():
            np.testing.assert_array_equal(getattr(frames.visibility(place), name), stored, err_msg=name)
            assert 0.005 < stored.mean() < 0.5
        made = arrays_of(frames.buffers(place)) | arrays_of(frames.guides_of(place))
        for name, stored in (arrays_of(sample.buffers) | arrays_of(sample.guides)).items():
            kept = round_to_8_bits(made[name]) if name in NOISY_GUIDES else made[name].astype(arrays[name].dtype)
            assert np.array_equal(kept.astype(np.float32), stored), name
    for name, stored in arrays_of(reader.read_photons(0)).items():
        np.testing.assert_allclose(getattr(frames.photons, name), stored, rtol=2e-3, atol=1e-3, err_msg=name)


def test_the_verb_writes_a_path_and_leaves_the_store_as_it_is(tmp_path: Path, spec: SceneSpec) -> None:
    store = Store(tmp_path / "store", create=True)
    store.add(spec)
    before = sorted(tmp_path.rglob("*"))
    place = ["buffers", "--store", str(store.root), "--scene", "room", "--out", str(tmp_path / "out.npz")]
    result = CliRunner().invoke(umbrella, [*place, "--orbit", "3"], catch_exceptions=False)
    assert (result.exit_code, result.stdout) == (0, f"{tmp_path / 'out.npz'}: 3 frames\n")
    frames = Frames.read(tmp_path / "out.npz")
    assert frames.depth.shape == (3, spec.film.height, spec.film.width)
    assert frames.point_seen.shape == (3, spec.points)
    assert frames.photon_seen.shape == (3, spec.photons.slots)
    assert frames.names == ("", *(group.name for group in spec.groups))
    assert {0, 1 + [group.name for group in spec.groups].index("sofa")} < set(frames.group.ravel().tolist())
    assert (frames.group.dtype, frames.group.shape) == (np.int16, frames.depth.shape)
    np.testing.assert_array_equal(frames.modification.vector, rest(spec).vector)
    assert sorted(tmp_path.rglob("*")) == sorted([*before, tmp_path / "out.npz"])
    for arguments in ([], ["--orbit", "3", "--camera-path", "file"]):
        assert (
            "one of --camera-path and --orbit is required" in CliRunner().invoke(umbrella, [*place, *arguments]).output
        )
    result = CliRunner().invoke(umbrella, [*place, "--orbit", "3", "--without", "piano"])
    assert isinstance(result.exception, SpecError)


def test_buffers_that_are_not_finite_are_not_written(spec: SceneSpec, room: LoadedScene, somewhere) -> None:
    class Broken:
        samples_at_once = 1
        base = room.base

        def apply(self, _) -> None: ...

        def photons(self, _) -> None: ...

        find_groups = room.find_groups

        def sees(self, views, position):
            return room.sees(views, position)

        def inputs(self, *arguments):
            return [
                (replace(buffers, depth=np.full((16, 24), np.nan, np.float32)), guides)
                for buffers, guides in room.inputs(*arguments)
            ]

    with pytest.raises(IncompleteError):
        frames_of(spec, rest(spec), [somewhere], load=lambda _: Broken())


def test_a_configuration_begins_with_a_key_a_row_or_the_scene_at_rest_then_the_path_changes_it_and_then_the_user(
    tmp_path: Path,
) -> None:
    store, spec = Store(tmp_path / "store", create=True), load_spec("room")
    scene = store.scene(store.plan(spec, Request(modifications=3), shard_rows=8).scene_id)
    planned, nothing = sample_modification(spec, 0, 1), Arrangement()
    views = [{"origin": [2, 1.5, 1.5], "look_at": [0, 0.5, 0]}]
    path = CameraPath.of(frames=1, views=views, without=["vase"], place={"sofa": (1, 0, 0)})

    def find(asked: Arrangement, **how: Any) -> np.ndarray:
        return find_views(store.root, scene.scene_id, asked, path, **how)[1].vector

    key = planned.key(spec.radiance_id).hex()
    wanted = path.apply(spec, planned).vector
    np.testing.assert_array_equal(find(nothing, like=key), wanted)
    np.testing.assert_array_equal(find(nothing, row=1), wanted)
    np.testing.assert_array_equal(find(nothing), path.apply(spec).vector)
    moved = find(Arrangement.of(place={"sofa": (1, 0, 0.5)}))
    np.testing.assert_allclose((moved - path.apply(spec).vector)[3], [0, 0, 0.5, 0], atol=1e-6)
    with pytest.raises(StoreError):
        find(nothing, like="0" * 32)
