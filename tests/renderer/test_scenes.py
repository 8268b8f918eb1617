import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonfarm.renderer import acceleration, backend
from photonfarm.renderer.scenes import LoadedScene
from photonfarm.shared.errors import SpecError
from photonfarm.shared.modification import Modification, rest, sample_modification
from photonfarm.shared.scene import SCENES_VARIABLE, SceneSpec, load_spec, parse_spec
from photonfarm.shared.view import Camera, View, sample_view

ROOT = Path(__file__).parents[2]
SOMEWHERE = View(np.array([1.9, 1.6, 1.7], np.float32), np.array([-0.7, 0.6, -0.5], np.float32))


def small(spec: SceneSpec, width: int = 24, height: int = 16, half_spp: int = 2) -> SceneSpec:
    film = spec.film.model_copy(update={"width": width, "height": height})
    transport = spec.transport.model_copy(update={"half_spp": half_spp})
    return spec.model_copy(update={"film": film, "transport": transport})


@pytest.fixture(scope="module")
def room() -> LoadedScene:
    backend.load(1)
    return LoadedScene.load(small(load_spec("room")))


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


# ------------------------------------------------------------------------------------------------ the built-in room


def test_no_kernel_is_new_after_the_second_modification() -> None:
    """Told by the kernels' hashes: one from the cache on disk counts, as it would have to be compiled once."""
    import drjit as dr

    backend.load(1)
    seen: set[str] = set()
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history_clear()
        room = LoadedScene.load(small(load_spec("room")))
        for i in range(12):
            modification = sample_modification(room.spec, 3, i)
            view = sample_view(room.spec, modification.key(room.spec.scene_id), 3, i)
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


def test_the_rest_state_comes_back_bit_by_bit(room: LoadedScene) -> None:
    room.apply(rest(room.spec))
    state, image, buffers = mesh_state(room), room.render_half(SOMEWHERE, 9), room.buffers(SOMEWHERE)
    for i in range(4):
        room.apply(sample_modification(room.spec, 1, i))
    assert mesh_state(room) != state
    room.apply(rest(room.spec))
    assert mesh_state(room) == state
    np.testing.assert_array_equal(room.render_half(SOMEWHERE, 9), image)
    np.testing.assert_array_equal(room.buffers(SOMEWHERE).depth, buffers.depth)
    np.testing.assert_array_equal(room.buffers(SOMEWHERE).albedo, buffers.albedo)


def test_the_way_to_a_configuration_leaves_no_trace(room: LoadedScene) -> None:
    target = sample_modification(room.spec, 7, 0)
    room.apply(rest(room.spec))
    room.apply(target)
    direct = mesh_state(room)
    for i in range(1, 4):
        room.apply(sample_modification(room.spec, 7, i))
    room.apply(target)
    assert mesh_state(room) == direct


def test_recorded_renders_follow_every_edit(room: LoadedScene) -> None:
    """`dr.freeze` replays kernels with what the scene holds now: bit by bit as when Python traces them again."""
    anew = backend.load(1).load_dict({"type": "bdpt", **room.spec.transport.model_dump(exclude={"half_spp"})})
    at_rest = rest(room.spec)
    for group in range(len(room.spec.groups)):
        moved, present = at_rest.translation.copy(), at_rest.present.copy()
        moved[group] += np.array([0.1, 0, 0.1], np.float32)
        present[group] = False
        for edit in (Modification(moved, at_rest.present), Modification(at_rest.translation, present), at_rest):
            room.apply(edit)
            traced = room.render(SOMEWHERE, 9, anew)
            np.testing.assert_array_equal(room.render_halves(SOMEWHERE, (9, 10))[0], traced)


def test_seeds_decide_the_noise_and_nothing_else_does(room: LoadedScene) -> None:
    room.apply(rest(room.spec))
    first, again, other = (room.render_half(SOMEWHERE, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)
    assert first.shape == (16, 24, 3)
    assert first.dtype == np.float32


def test_translated_meshes_keep_their_modelled_normals(room: LoadedScene) -> None:
    room.apply(rest(room.spec))
    before = {key: value for key, value in mesh_state(room).items() if key.endswith(" normals")}
    modification = sample_modification(room.spec, 2, 0)
    room.apply(Modification(modification.translation, np.ones_like(modification.present)))
    after = {key: value for key, value in mesh_state(room).items() if key.endswith(" normals")}
    assert len(before) >= 4
    assert after == before


def test_what_is_parked_stays_in_the_bounding_box_and_out_of_sight(room: LoadedScene) -> None:
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
    assert not room.render_half(SOMEWHERE, 1).any()  # every light is gone
    photons = room.photons(1)
    assert photons is not None
    assert not photons.power.any()


def test_the_camera_of_the_sensor_is_that_of_the_spec(room: LoadedScene) -> None:
    mi = backend.load(1)
    spec = room.spec
    sensor = room._sensor.aim(SOMEWHERE)
    camera = Camera.of(SOMEWHERE, spec)
    x, y = np.meshgrid((np.arange(24) + 0.5) / 24, (np.arange(16) + 0.5) / 16)
    place = mi.Point2f(mi.Float(x.ravel().astype(np.float32)), mi.Float(y.ravel().astype(np.float32)))
    ray, _ = sensor.sample_ray(0, 0, place, mi.Point2f(0.5))
    np.testing.assert_allclose(np.array(ray.d).T.reshape(16, 24, 3), camera.rays(), atol=2e-6)
    along = camera.rays() @ camera.forward
    start = camera.origin + camera.rays() * (spec.view.near / along)[..., None]
    np.testing.assert_allclose(np.array(ray.o).T.reshape(16, 24, 3), start, atol=1e-5)
    np.testing.assert_allclose(np.array(ray.maxt).reshape(16, 24), (spec.view.far - spec.view.near) / along, rtol=1e-5)


def test_buffers_agree_with_rays_through_the_moved_scene(room: LoadedScene) -> None:
    mi = backend.load(1)
    modification = sample_modification(room.spec, 2, 3)
    room.apply(modification)
    camera = Camera.of(SOMEWHERE, room.spec)
    depth = room.buffers(SOMEWHERE).depth
    rays = camera.rays().reshape(-1, 3)
    si = room.scene.ray_intersect(mi.Ray3f(mi.Point3f(*map(float, camera.origin)), mi.Vector3f(*rays.T)))
    hit = camera.origin + rays * (depth.ravel() / (rays @ camera.forward))[:, None]
    np.testing.assert_allclose(hit, np.array(si.p).T, atol=2e-4)


def test_a_static_scene_has_one_configuration() -> None:
    backend.load(1)
    cornell = LoadedScene.load(small(load_spec("cornell")))
    assert not cornell.spec.groups
    cornell.apply(rest(cornell.spec))
    view = View(np.array([0, 1, 1.5], np.float32), np.array([0, 1, -1], np.float32))
    assert cornell.render_half(view, 0).mean() > 0.05


def test_no_photons_are_traced_where_the_spec_wants_none() -> None:
    backend.load(1)
    spec = small(load_spec("cornell"))
    spec = spec.model_copy(update={"photons": spec.photons.model_copy(update={"paths": 0})})
    assert LoadedScene.load(spec).photons(1) is None


def same_image_and_buffers(one: LoadedScene, other: LoadedScene) -> None:
    np.testing.assert_array_equal(one.render_half(SOMEWHERE, 5), other.render_half(SOMEWHERE, 5))
    first, second = one.buffers(SOMEWHERE), other.buffers(SOMEWHERE)
    for name in ("depth", "albedo", "normal"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_after_many_edits_a_scene_gives_the_bytes_of_a_fresh_load(room: LoadedScene) -> None:
    target = sample_modification(room.spec, 4, 9)
    for i in range(6):
        room.apply(sample_modification(room.spec, 4, i))
    room.apply(target)
    fresh = LoadedScene.load(room.spec)
    fresh.apply(target)
    same_image_and_buffers(room, fresh)


# ------------------------------------------------------------------------------------- Embree, told to expect changes


def test_embree_finds_the_same_surfaces_when_it_expects_changes(
    room: LoadedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acceleration, "_embree", lambda: None)
    assert not acceleration.expect_changes(room.scene)
    as_mitsuba_builds_it = LoadedScene.load(room.spec)
    for i in range(3):
        modification = sample_modification(room.spec, 5, i)
        room.apply(modification)
        as_mitsuba_builds_it.apply(modification)
        first, second = (loaded.buffers(SOMEWHERE) for loaded in (room, as_mitsuba_builds_it))
        np.testing.assert_allclose(first.depth, second.depth, rtol=1e-5)
        # where surfaces touch, a ray may meet either of them first
        assert (first.normal != second.normal).any(axis=-1).mean() < 0.01


def test_embree_can_be_told_to_expect_changes_and_each_scene_is_told_by_itself() -> None:
    mi = backend.load(1)
    scenes = [mi.load_dict({"type": "scene", "s": {"type": "sphere", "radius": r}}, optimize=False) for r in (1.0, 2.0)]
    pending = scenes[1].ray_test(mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1)))  # not to be taken for another's
    (entry, first), (other_entry, second) = (acceleration._traced_by(scene) for scene in scenes)
    assert entry == other_entry != 0
    assert 0 != first != second != 0
    assert all(acceleration.expect_changes(scene) for scene in scenes)
    assert pending[0]


def test_a_ray_that_comes_from_no_known_function_of_embree_changes_nothing(
    room: LoadedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acceleration, "_entry_points", lambda _: {0xBAD})
    assert not acceleration.expect_changes(room.scene)


# ----------------------------------------------------------------------------- a scene file, edited and written anew

GROUND = '<shape type="rectangle" id="Ground"><transform name="to_world"><rotate x="1" angle="-90"/>'
GROUND += '<scale value="4"/></transform></shape>'
LAMP = '<emitter type="area"><rgb name="radiance" value="6, 5, 4"/></emitter>'


def sphere(at: float, name: str = "Lamp", inside: str = LAMP) -> str:
    place = f'<point name="center" x="{at}" y="1" z="0"/><float name="radius" value="0.4"/>'
    return f'<shape type="sphere" id="{name}">{place}{inside}</shape>'


def cube(at: float) -> str:
    move = f'<transform name="to_world"><scale value="0.4"/><translate x="{at}" y="0.6" z="0.5"/></transform>'
    return f'<shape type="cube" id="Block">{move}<bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>'


def file_scene(folder: Path, content: str, **changes: Any) -> LoadedScene:
    backend.load(1)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{GROUND}{content}</scene>')
    everywhere = {"min": [-4, 0, -4], "max": [4, 3, 4]}
    described = {
        "name": "edited",
        "scene": {"file": "scene.xml"},
        "view": {"origin": everywhere, "look_at": everywhere, "fov_deg": 70},
        "film": {"width": 16, "height": 16},
        "transport": {"max_depth": 4, "half_spp": 64},
        "points": 64,
        **changes,
    }
    return LoadedScene.load(parse_spec(described, where="test", beside=folder), folder)


def group(name: str, shape: str) -> dict[str, Any]:
    return {"name": name, "shapes": [shape], "at": [0, 0, 0], "box": {"min": [-9, 0, 0], "max": [9, 0, 0]}}


GROUPS = {"objects": [group("block", "Block")], "lights": [group("lamp", "Lamp")]}
FROM_ABOVE = View(np.array([0, 3.5, 3.5], np.float32), np.array([0, 0, 0], np.float32))


def placed(loaded: LoadedScene, block: float | None, lamp: float | None) -> LoadedScene:
    translation = np.array([[block or 0, 0, 0], [lamp or 0, 0, 0]], np.float32)
    loaded.apply(Modification(translation, np.array([block is not None, lamp is not None])))
    return loaded


def assert_equal_images(edited: LoadedScene, anew: LoadedScene) -> None:
    """Means of 8 independent renders, in 16 blocks per channel: |z| < 4.5 (for 48 tests, false alarm below 1e-3).

    Depth buffers agree exactly but for rounding.
    """
    runs = [
        np.stack([loaded.render_half(FROM_ABOVE, 100 * k + seed) for seed in range(8)])
        .reshape(8, 4, 4, 4, 4, 3)
        .mean(axis=(2, 4))
        for k, loaded in enumerate((edited, anew))
    ]
    difference = runs[0].mean(0) - runs[1].mean(0)
    error = np.sqrt((runs[0].var(0, ddof=1) + runs[1].var(0, ddof=1)) / 8)
    # a variance from 8 runs is itself noisy: the block's error is bounded below by half the mean error
    assert np.abs(difference / np.maximum(error, 0.5 * error.mean())).max() < 4.5
    np.testing.assert_allclose(edited.buffers(FROM_ABOVE).depth, anew.buffers(FROM_ABOVE).depth, atol=1e-4)


@pytest.mark.parametrize("sky", ["", '<emitter type="constant"><rgb name="radiance" value="0.2"/></emitter>'])
def test_an_edited_scene_renders_like_one_written_anew(sky: str, tmp_path: Path) -> None:
    edited = placed(file_scene(tmp_path / "a", sky + cube(0) + sphere(0), **GROUPS), 1.5, -2.0)
    anew = file_scene(tmp_path / "b", sky + cube(1.5) + sphere(-2.0))
    assert_equal_images(edited, anew)


def test_what_is_removed_has_no_effect_on_light(tmp_path: Path) -> None:
    other = sphere(2, "Other")
    edited = placed(file_scene(tmp_path / "a", other + cube(0) + sphere(0), **GROUPS), None, None)
    assert_equal_images(edited, file_scene(tmp_path / "b", other))


CHECKS = '<texture name="radiance" type="checkerboard"><rgb name="color0" value="0.5, 0.6, 0.7"/></texture>'
PANEL = '<shape type="rectangle" id="Lamp"><transform name="to_world"><rotate x="1" angle="90"/><translate y="2"/>'
PANEL += f'</transform><emitter type="area">{CHECKS}</emitter></shape>'


@pytest.mark.parametrize("lamp", [sphere(0), PANEL], ids=["sphere", "textured panel"])
def test_a_light_that_comes_back_shines_as_before(lamp: str, tmp_path: Path) -> None:
    edited = file_scene(tmp_path / "a", cube(0) + lamp, **GROUPS)
    before = edited.render_half(FROM_ABOVE, 3)
    assert not placed(edited, 0.0, None).render_half(FROM_ABOVE, 3).any()
    np.testing.assert_array_equal(placed(edited, 0.0, 0.0).render_half(FROM_ABOVE, 3), before)


def test_the_sky_s_bounding_sphere_follows_objects_beyond_the_old_box(tmp_path: Path) -> None:
    """A stale sphere ends Mitsuba's shadow rays to the sky before the moved block, which then casts no shadow."""
    sky = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'
    edited = file_scene(tmp_path / "a", sky + cube(0), objects=[group("block", "Block")])
    edited.apply(Modification(np.array([[40, 0, 0]], np.float32), np.array([True])))
    told = float(str(edited.scene.environment()).split("radius = [")[1].split("]")[0])
    box = edited.scene.bbox()
    assert told >= 0.5 * max(box.max[i] - box.min[i] for i in range(3))


def test_a_light_that_the_spec_adds_faces_down_and_moves(tmp_path: Path) -> None:
    box = {"min": [-1, 2, -1], "max": [1, 2, 1]}
    rectangle = {"size": [1.0, 0.5], "radiance": [5, 5, 5]}
    added = {"name": "added", "at": [0, 2, 0], "box": box, "rectangle": rectangle}
    loaded = file_scene(tmp_path, cube(0), lights=[added], points=4096)
    geometry, cloud = loaded.base()
    shines = cloud.emission[:, 0] > 0
    assert shines.any()
    np.testing.assert_allclose(cloud.normal[shines], np.tile([0.0, -1, 0], (shines.sum(), 1)), atol=1e-6)
    light = geometry.shape_group[geometry.face_shape] == 0
    assert geometry.areas()[light].sum() == pytest.approx(0.5)
    loaded.apply(Modification(np.array([[0.5, 0, 0.25]], np.float32), np.array([True])))
    lamp = next(shape for shape in loaded.scene.shapes() if shape.id() == "added")
    assert [round(lamp.bbox().min[i], 5) for i in range(3)] == [0.0, 2.0, 0.0]
    assert [round(lamp.bbox().max[i], 5) for i in range(3)] == [1.0, 2.0, 0.5]


def test_a_scene_file_that_changed_since_the_spec_was_read_is_refused(tmp_path: Path) -> None:
    spec = file_scene(tmp_path, cube(0)).spec
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{GROUND}{cube(1)}</scene>')
    with pytest.raises(SpecError, match="is not what the spec was made from"):
        LoadedScene.load(spec, tmp_path)


def test_a_scene_that_mitsuba_cannot_load_is_a_spec_error(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="Mitsuba cannot load it"):
        file_scene(tmp_path, '<bsdf type="difuse" id="paint"/>')


@pytest.mark.parametrize("kind", ["instance", "bsplinecurve", "teapot"])
def test_shapes_without_a_point_cloud_are_refused_before_mitsuba_sees_them(kind: str, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=rf"<shape> 'T': shapes of type '{kind}' are not supported; only obj, ply"):
        file_scene(tmp_path, f'<shape type="{kind}" id="T"/>')


def test_settings_that_the_integrator_refuses_are_a_spec_error() -> None:
    backend.load(1)
    spec = load_spec("cornell")
    transport = spec.transport.model_copy(update={"connections": 2, "light_ratio": 0.0})
    with pytest.raises(SpecError, match=r"transport: .*connections is 2 and light_ratio is 0"):
        LoadedScene.load(spec.model_copy(update={"transport": transport}))


# --------------------------------------------------------------------------------------------------------- real rooms


@pytest.mark.slow
@pytest.mark.parametrize("name", ["veach-ajar", "dining-room", "living-room-2"])
def test_a_real_room_is_loaded_edited_and_rendered(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(os.environ.get(SCENES_VARIABLE) or ROOT.parent / "shared/scenes")
    if not (folder / name / "scene.xml").is_file():
        pytest.skip(f"the real rooms are not here; set {SCENES_VARIABLE} to their folder")
    monkeypatch.setenv(SCENES_VARIABLE, str(folder))
    backend.load(1)
    spec = small(load_spec(ROOT / f"scenes/{name}.toml"), 16, 16, 4)
    loaded = LoadedScene.load(spec)
    modification = sample_modification(spec, 0, 1)
    loaded.apply(modification)
    view = sample_view(spec, modification.key(spec.scene_id), 0, 0)
    image = loaded.render_half(view, 0)
    assert np.all(np.isfinite(image))
    assert image.mean() > 0
    assert (loaded.buffers(view).depth > 0).mean() > 0.5
    geometry, cloud = loaded.base()
    assert len(geometry.shape_group) == len(loaded.scene.shapes())
    assert np.all(np.isfinite(cloud.normal))
    assert set(np.unique(cloud.group)) <= {-1, *range(len(spec.groups))}


def test_a_mesh_light_with_smooth_normals_is_refused_and_a_flat_one_is_not(tmp_path: Path) -> None:
    import trimesh

    trimesh.creation.icosphere(subdivisions=1).export(tmp_path / "bulb.ply")
    unit = {"min": [0, 0, 0], "max": [1, 1, 1]}
    described = {"name": "bulb", "scene": {"file": "scene.xml"}, "view": {"origin": unit, "look_at": unit}}

    def load(flat: bool) -> LoadedScene:
        (tmp_path / "scene.xml").write_text(
            '<scene version="3.0.0"><shape type="ply" id="Bulb"><string name="filename" value="bulb.ply"/>'
            f'<boolean name="face_normals" value="{str(flat).lower()}"/><emitter type="area"/></shape>'
            '<shape type="rectangle" id="Floor"/></scene>'
        )
        return LoadedScene.load(parse_spec(described, where="test", beside=tmp_path), tmp_path)

    with pytest.raises(SpecError, match="mesh light 'Bulb' has smooth vertex normals"):
        load(flat=False)
    assert load(flat=True).photons(0).power.sum() > 0  # type: ignore[union-attr]
