"""The built-in room edited in place: nothing of an edit is left over, and nothing is compiled for the next."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from photonfarm.renderer.scene import backend, native
from photonfarm.renderer.scene.gbuffer import view_buffers
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.modification import Modification, rest, sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import View, sample_view


def mesh_state(loaded: LoadedScene) -> dict[str, bytes]:
    buffers = {}
    for shape in loaded.scene.shapes():
        if shape.is_mesh():
            buffers[shape.id()] = np.array(shape.vertex_positions_buffer()).tobytes()
            if shape.has_vertex_normals():
                buffers[shape.id() + " normals"] = np.array(shape.vertex_normals_buffer()).tobytes()
        else:
            buffers[shape.id()] = str(shape.bbox()).encode()
    return buffers


def corners(loaded: LoadedScene) -> np.ndarray:
    box = loaded.scene.bbox()
    return np.array([[corner[i] for i in range(3)] for corner in (box.min, box.max)])


def same_image_and_buffers(one: LoadedScene, other: LoadedScene, view: View) -> None:
    np.testing.assert_array_equal(one.render_half(view, 5), other.render_half(view, 5))
    first, second = one.buffers(view), other.buffers(view)
    for name in ("depth", "albedo", "normal"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_no_kernel_is_new_after_the_second_modification(small: Callable[..., SceneSpec]) -> None:
    """Told by the kernels' hashes: one from the cache on disk counts, as it would have to be compiled once."""
    import drjit as dr

    seen: set[str] = set()
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        room = LoadedScene.load(small(load_spec("room")))
        for i in range(12):
            modification = sample_modification(room.spec, 3, i)
            view = sample_view(room.spec, modification.key(room.spec.radiance_id), 3, i)
            room.apply(modification)
            room.buffers(view)
            room.render_half(view, 2 * i)
            room.photons(i)
            used = {kernel["hash"]: kernel["size"] for kernel in dr.kernel_history() if "hash" in kernel}
            new = [used[kernel] for kernel in used.keys() - seen]
            assert i < 2 or not new, f"modification {i} used new kernels of sizes {new}"
            seen |= used.keys()
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, False)


def test_recorded_buffers_and_photons_are_those_that_python_traces_anew(room: LoadedScene) -> None:
    """Bit by bit, in every configuration, with pieces that come back and that are gone."""
    from photonfarm.renderer.bdpt.photons import trace_photons

    wanted = room.spec.photons
    for i in range(5):
        modification = sample_modification(room.spec, 11, i)
        room.apply(modification)
        view = sample_view(room.spec, modification.key(room.spec.radiance_id), 11, i)
        recorded, anew = room.buffers(view), view_buffers(room.scene, [view], room.spec)[0]
        photons = room.photons(i)
        assert photons is not None
        hits = trace_photons(room.scene, seed=i, paths=wanted.paths, depth=wanted.depth)
        for name in ("depth", "albedo", "normal"):
            np.testing.assert_array_equal(getattr(recorded, name), getattr(anew, name))
        for name in ("position", "direction", "normal", "power", "bounce"):
            np.testing.assert_array_equal(getattr(photons, name), getattr(hits, name))
        assert photons.power.sum() > 0


def test_after_many_edits_a_scene_gives_the_bytes_of_a_fresh_load(room: LoadedScene, somewhere: View) -> None:
    target = sample_modification(room.spec, 4, 9)
    for i in range(6):
        room.apply(sample_modification(room.spec, 4, i))
    room.apply(target)
    fresh = LoadedScene.load(room.spec)
    fresh.apply(target)
    same_image_and_buffers(room, fresh, somewhere)


def test_recorded_renders_follow_every_edit(room: LoadedScene, somewhere: View) -> None:
    """`dr.freeze` replays kernels with what the scene holds now: bit by bit as when Python traces them again."""
    anew = backend.load(1).load_dict({"type": "bdpt", **room.spec.transport.model_dump(exclude={"half_spp"})})
    at_rest = rest(room.spec)
    for group in range(len(room.spec.groups)):
        moved, present = at_rest.translation.copy(), at_rest.present.copy()
        moved[group] += np.array([0.1, 0, 0.1], np.float32)
        present[group] = False
        for edit in (Modification(moved, at_rest.present), Modification(at_rest.translation, present), at_rest):
            room.apply(edit)
            traced = room.render(somewhere, 9, anew)
            np.testing.assert_array_equal(room.render_halves(somewhere, (9, 10))[0], traced)


def test_translated_meshes_keep_their_modelled_normals(room: LoadedScene) -> None:
    room.apply(rest(room.spec))
    before = {key: value for key, value in mesh_state(room).items() if key.endswith(" normals")}
    modification = sample_modification(room.spec, 2, 0)
    room.apply(Modification(modification.translation, np.ones_like(modification.present)))
    after = {key: value for key, value in mesh_state(room).items() if key.endswith(" normals")}
    assert len(before) >= 4
    assert after == before


def test_what_is_parked_stays_in_the_bounding_box_and_out_of_sight(room: LoadedScene, somewhere: View) -> None:
    mi = backend.load(1)
    room.apply(rest(room.spec))
    box = corners(room)
    everything = rest(room.spec)
    room.apply(Modification(everything.translation, np.zeros_like(everything.present)))
    np.testing.assert_allclose(corners(room), box, atol=1e-7)
    static = {"floor", "ceiling", "skirting", "door", "painting-frame", "painting", "rug"}
    rng = np.random.default_rng(4)
    d = rng.normal(size=(3, 20000)).astype(np.float32)
    hit = room.scene.ray_intersect_preliminary(
        mi.Ray3f(mi.Point3f(0, 1, 0), mi.Vector3f(*d / np.linalg.norm(d, axis=0)))
    )
    seen = {room.scene.shapes()[i].id() for i in np.unique(np.array(hit.shape_index))}
    assert {name for name in seen if not name.startswith("wall")} <= static
    assert not room.render_half(somewhere, 1).any()  # every light is gone
    photons = room.photons(1)
    assert photons is not None
    assert not photons.power.any()


# ------------------------------------------------ Embree, told to expect changes --------------------------------------


def test_embree_finds_the_same_surfaces_when_it_expects_changes(
    room: LoadedScene, monkeypatch: pytest.MonkeyPatch, somewhere: View
) -> None:
    monkeypatch.setattr(native, "_open_embree", lambda: None)
    assert not native.expect_changes(room.scene)
    as_mitsuba_builds_it = LoadedScene.load(room.spec)
    for i in range(3):
        modification = sample_modification(room.spec, 5, i)
        room.apply(modification)
        as_mitsuba_builds_it.apply(modification)
        first, second = (loaded.buffers(somewhere) for loaded in (room, as_mitsuba_builds_it))
        np.testing.assert_allclose(first.depth, second.depth, rtol=1e-5)
        # where surfaces touch, a ray may meet either of them first
        assert (first.normal != second.normal).any(axis=-1).mean() < 0.01


def test_what_did_not_move_is_not_built_again_and_rays_meet_the_same(room: LoadedScene, somewhere: View) -> None:
    """Bit by bit, with pieces and lights that move, are gone and come back."""
    whole = LoadedScene.load(room.spec)
    assert room._changing is not None
    whole._changing = None  # Mitsuba gives Embree every shape anew
    configurations = [sample_modification(room.spec, 6, i) for i in range(3)]
    for i, modification in enumerate([configurations[0], rest(room.spec).without_groups(), *configurations[1:]]):
        for loaded in (room, whole):
            loaded.apply(modification)
        same_image_and_buffers(room, whole, somewhere)
        of_moved, of_all = room.photons(i), whole.photons(i)
        assert of_moved is not None
        assert of_all is not None
        np.testing.assert_array_equal(of_moved.position, of_all.position)


def test_shapes_that_are_no_meshes_and_those_that_leave_the_scene_s_box_are_met_where_they_are(
    file_scene: Callable[..., LoadedScene], tmp_path: Path
) -> None:
    """Bit by bit, as where Mitsuba gives Embree every shape anew, and so is the light of a sky around the box."""
    ball = '<shape type="sphere" id="Ball"><point name="center" x="0" y="1" z="0"/><float name="radius" value="0.5"/>'
    tall = '<shape type="cube" id="Tall"><transform name="to_world"><scale x="0.1" y="3" z="0.1"/></transform></shape>'
    box = {"min": [-9, 1, -9], "max": [9, 1, 9]}
    described = {"name": "ball", "shapes": ["Ball"], "at": [0, 1, 0], "box": box, "removal_probability": 0.5}
    content = f'{ball}</shape>{tall}<emitter type="constant"/>'
    edited, whole = (file_scene(tmp_path, content, objects=[described]) for _ in range(2))
    assert edited._changing is not None
    whole._changing = None
    view = View(np.array([0, 2, 3.5], np.float32), np.array([0, 1, 0], np.float32))
    for x, present in ((1, True), (2, True), (8, True), (1.5, True), (1.5, False), (-1, True)):
        standing = Modification(np.array([[x, 0, 0]], np.float32), np.array([present]))
        for loaded in (edited, whole):
            loaded.apply(standing)
        np.testing.assert_array_equal(corners(edited), corners(whole))
        same_image_and_buffers(edited, whole, view)
        assert (1 in edited.find_groups([view])) == (present and x < 8)


def test_embree_can_be_told_to_expect_changes_and_each_scene_is_told_by_itself() -> None:
    mi = backend.load(1)
    scenes = [mi.load_dict({"type": "scene", "s": {"type": "sphere", "radius": r}}, optimize=False) for r in (1.0, 2.0)]
    pending = scenes[1].ray_test(mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1)))  # not to be taken for another's
    (entry, first), (other_entry, second) = (native._find_embree_scene(scene) for scene in scenes)
    assert entry == other_entry != 0
    assert 0 != first != second != 0
    assert all(native.expect_changes(scene) for scene in scenes)
    assert pending[0]
