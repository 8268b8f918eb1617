"""Scenes that are loaded, and those that are refused in a sentence."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from photonfarm.core.errors import SpecError
from photonfarm.farm.devices import Card
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.modification import sample_modification
from photonfarm.scene.spec import SceneSpec, Transport
from photonfarm.scene.spec_loading import SCENES_VARIABLE, load_spec, parse_spec
from photonfarm.scene.view import sample_view

ROOT = Path(__file__).parents[3]


def test_a_scene_file_that_changed_since_the_spec_was_read_is_refused(
    file_scene: Callable[..., LoadedScene], tmp_path: Path
) -> None:
    spec = file_scene(tmp_path, '<shape type="cube" id="Block"/>').spec
    file = tmp_path / "scene.xml"
    file.write_text(file.read_text().replace("cube", "rectangle"))
    with pytest.raises(SpecError):
        LoadedScene.load(spec, tmp_path)


def test_a_scene_that_mitsuba_cannot_load_is_a_spec_error(
    file_scene: Callable[..., LoadedScene], tmp_path: Path
) -> None:
    with pytest.raises(SpecError):
        file_scene(tmp_path, '<bsdf type="difuse" id="paint"/>')


@pytest.mark.parametrize("kind", ["instance", "bsplinecurve", "teapot"])
def test_shapes_without_a_point_cloud_are_refused_before_mitsuba_sees_them(
    file_scene: Callable[..., LoadedScene], kind: str, tmp_path: Path
) -> None:
    with pytest.raises(SpecError, match=f"'{kind}'"):
        file_scene(tmp_path, f'<shape type="{kind}" id="T"/>')


def test_settings_that_the_integrator_refuses_are_a_spec_error() -> None:
    spec = load_spec("cornell")
    transport = spec.transport.model_copy(update={"connections": 2, "light_ratio": 0.0})
    with pytest.raises(SpecError):
        LoadedScene.load(spec.model_copy(update={"transport": transport}))


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

    with pytest.raises(SpecError):
        load(flat=False)
    assert load(flat=True).photons(0).power.sum() > 0  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["veach-ajar", "dining-room", "living-room-2"])
def test_a_real_room_is_loaded_edited_and_rendered(
    small: Callable[..., SceneSpec], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(os.environ.get(SCENES_VARIABLE) or ROOT.parent / "shared/scenes")
    if not (folder / name / "scene.xml").is_file():
        pytest.skip(f"the real rooms are not here; set {SCENES_VARIABLE} to their folder")
    monkeypatch.setenv(SCENES_VARIABLE, str(folder))
    spec = small(load_spec(ROOT / f"scenes/{name}.toml"), 16, 16, 4)
    loaded = LoadedScene.load(spec)
    modification = sample_modification(spec, 0, 1)
    loaded.apply(modification)
    view = sample_view(spec, modification.key(spec.radiance_id), 0, 0)
    image = loaded.render_half(view, 0)
    assert np.all(np.isfinite(image))
    assert image.mean() > 0
    assert (loaded.buffers(view).depth > 0).mean() > 0.5
    geometry, cloud = loaded.base()
    assert len(geometry.shape_group) == len(loaded.scene.shapes())
    assert np.all(np.isfinite(cloud.normal))
    assert set(np.unique(cloud.group)) <= {-1, *range(len(spec.groups))}


def test_a_card_renders_by_the_strategy_that_the_spec_has_for_cards(
    small: Callable[..., SceneSpec], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The device is said to be a card; what renders is a processor."""
    spec = small(load_spec("cornell"))
    plain = {"connections": 0, "light_ratio": 0.0}
    spec = spec.model_copy(
        update={"transport": Transport.model_validate({**spec.transport.model_dump(), "card": plain})}
    )
    assert LoadedScene.load(spec).spec.strategy()["light_ratio"] == 1
    card = Card(0, "a card", "9.0", 1 << 34)
    monkeypatch.setattr(backend, "device", lambda: backend.Device(backend.DEFAULT_VARIANT, card, ""))
    assert LoadedScene.load(spec).spec.strategy() == {**spec.strategy(), **plain}


def test_a_strategy_for_cards_must_be_one() -> None:
    for wrong in ({"connections": 1, "light_ratio": 0}, {"half_spp": 3}):
        with pytest.raises(ValidationError):
            Transport.model_validate({"card": wrong})
