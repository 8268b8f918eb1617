"""Free space as it is measured by rays, and cameras that keep to it, looked at by other rays."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SpecError
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.scene.surroundings import NONE
from photonfarm.renderer.tools.measure.free_space import measure
from photonfarm.scene.modification import sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import sample_view


def quietly(_line: str) -> None: ...


def cameras(spec: SceneSpec, scene: LoadedScene, configurations: int, views: int) -> tuple[int, int, float]:
    """How many of random cameras stand inside a solid or not in the open, and the least distance to a surface."""
    inside = not_open = 0
    least = np.inf
    for number in range(configurations):
        modification = sample_modification(spec, 0, number)
        scene.apply(modification)
        key = modification.key(spec.radiance_id)
        origins = np.stack([sample_view(spec, key, 0, i, modification).origin for i in range(views)])
        here = scene.surroundings(origins)
        inside += int((here.solid != NONE).sum())
        not_open += int((~here.open).sum())
        least = min(least, float(here.clearance.min()))
    return inside, not_open, least


def with_free_space(spec: SceneSpec) -> SceneSpec:
    space = measure(spec, None, quietly).space
    return spec.model_copy(update={"view": spec.view.model_copy(update={"free_space": space})})


def test_no_camera_of_the_room_stands_in_furniture(room) -> None:
    """Nor closer to it than the near plane would show; without free space some do."""
    kept = with_free_space(room.spec)
    assert cameras(room.spec, room, 30, 40)[0] > 0, "or this test asks nothing"
    inside, not_open, least = cameras(kept, room, 30, 40)
    assert (inside, not_open) == (0, 0)
    assert least > room.spec.view.near


SHAPES = """
<shape type="cube" id="Room"><transform name="to_world"><scale x="3" y="1.5" z="2"/><translate y="1.5"/></transform>
</shape>
<shape type="cube" id="Pillar"><transform name="to_world"><scale x="0.5" y="1.5" z="0.5"/><translate x="-1" y="1.5"/>
</transform></shape>
<shape type="cube" id="Crate"><transform name="to_world"><scale value="0.4"/><translate x="1.5" y="0.4"/></transform>
</shape>
<emitter type="constant"/>
"""


def of_file(file_scene: Any, folder: Path, **view: Any) -> LoadedScene:
    low, high = [-4, 0.2, -3], [4, 2.8, 3]  # larger than the room, whose floor is 6 × 4
    crate = {
        "name": "crate",
        "shapes": ["Crate"],
        "at": [1.5, 0, 0],
        "removal_probability": 0,
        "box": {"min": [-2.5, 0, -1.5], "max": [2.5, 0, 1.5]},
    }
    box = {"min": low, "max": high}
    look_at = {"min": [-2.5, 0.5, -1.5], "max": [2.5, 2.5, 1.5]}
    return file_scene(folder, SHAPES, objects=[crate], view={"origin": box, "look_at": look_at, **view})


def test_cameras_keep_out_of_solids_and_in_the_room_of_a_scene_file(file_scene, tmp_path) -> None:
    scene = of_file(file_scene, tmp_path)
    found = measure(scene.spec, tmp_path, quietly)
    in_room, pillar = 6 * 4 * 2.6, 1 * 1 * 2.6  # of the volume of the box of origins
    assert found.still < (in_room - pillar) / (8 * 6 * 2.6) < 1.5 * found.still, "free but for a margin at all surfaces"
    assert found.free < found.still
    kept = scene.spec.model_copy(update={"view": scene.spec.view.model_copy(update={"free_space": found.space})})
    assert cameras(scene.spec, scene, 5, 100)[1] > 100, "or this test asks nothing"
    assert cameras(kept, scene, 20, 50)[:2] == (0, 0)


def test_a_box_of_origins_within_a_solid_is_refused(file_scene, tmp_path) -> None:
    within = {"min": [-1.2, 1, -0.2], "max": [-0.8, 2, 0.2]}
    scene = of_file(file_scene, tmp_path, origin=within)
    with pytest.raises(SpecError, match=r"view\.origin"):
        measure(scene.spec, tmp_path, quietly)


def test_the_verb_writes_it_into_the_spec_and_measures_again_what_has_changed(tmp_path) -> None:
    built_in = Path(load_spec.__code__.co_filename).parent / "specs/room.toml"
    file = tmp_path / "own.toml"
    file.write_text(built_in.read_text())
    before = load_spec(file)
    assert CliRunner().invoke(umbrella, ["scene", "free-space", str(file), "--write"]).exit_code == 0
    written = load_spec(file)
    assert written.view.free_space is not None
    assert written.scene_id != before.scene_id
    assert "# 0.9 of the room, at heights between sitting and standing" in file.read_text()
    file.write_text(file.read_text().replace("max = [2.3, 2.0, 1.9] }\nlook_at", "max = [2.2, 2.0, 1.9] }\nlook_at"))
    with pytest.raises(SpecError):
        load_spec(file)
    assert CliRunner().invoke(umbrella, ["scene", "free-space", str(file), "--write"]).exit_code == 0
    assert load_spec(file).view.free_space.of != written.view.free_space.of
    assert CliRunner().invoke(umbrella, ["scene", "free-space", "room", "--write"]).exit_code != 0, "it is built in"
