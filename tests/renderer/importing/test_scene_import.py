"""`photonfarm scene import`: from a file to a spec that renders, and what is said where that cannot be."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner, Result

from photonfarm.core.errors import BackendError, PhotonfarmError, SpecError
from photonfarm.core.pictures import display_values
from photonfarm.renderer.cli.scene_verbs import scene_import
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.renderer.tools.importing import importer
from photonfarm.renderer.tools.importing.readers import blender
from photonfarm.scene.modification import rest, sample_modification
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import sample_view


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """Function (arguments) → the result of the verb, in an empty folder."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return lambda *arguments: CliRunner().invoke(scene_import, [str(a) for a in arguments])


def test_a_room_becomes_a_spec_with_comments_that_renders_at_once_wherever_it_is(
    quick: None, boxes: Path, run: Callable[..., Result], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(boxes.parent, "source")
    result = run("source/room.gltf", "--out", "my/den.toml", "--json")
    assert result.exit_code == 0, result.output
    assert Path(json.loads(result.stdout)["spec"]) == Path("my/den.toml")
    assert sorted(path.name for path in Path("my").iterdir()) == ["den-scene", "den.toml"]
    text = " ".join(Path("my/den.toml").read_text().replace("\n# ", " ").split())
    assert "Made by `photonfarm scene import` from room.gltf" in text
    assert "run `photonfarm scene free-space SPEC --write` again" in text
    shutil.move("my", tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path / "elsewhere")
    shutil.rmtree(tmp_path / "here")
    spec = load_spec("den.toml")
    assert spec.name == "den"
    assert sorted(group.name for group in spec.groups) == ["Chairs", "Chairs-2", "Table", "Wardrobe", "ceiling-light"]
    scene = LoadedScene.load(spec, Path())
    shown = []
    for number in range(6):
        modification = sample_modification(spec, 1, number)
        scene.apply(modification)
        view = sample_view(spec, modification.key(spec.radiance_id), 1, number, modification)
        assert scene.surroundings(view.origin[None]).open.all()
        depth = scene.buffers(view).depth
        assert (depth > 0).mean() > 0.99  # no view leaves the room
        shown.append(display_values(np.float32(spec.exposure) * scene.render_halves(view, (number,), 2)[0]))
    assert np.mean(shown) == pytest.approx(0.45, abs=0.12)


def test_what_is_there_is_never_written_over(boxes: Path, run: Callable[..., Result]) -> None:
    Path("room.toml").write_text("mine")
    result = run(boxes)
    assert isinstance(result.exception, SpecError)
    assert Path("room.toml").read_text() == "mine"
    assert [path.name for path in Path().iterdir()] == ["room.toml"]


@pytest.mark.parametrize(
    ("name", "kind", "code"),
    [
        ("gone.glb", SpecError, 3),
        ("notes.txt", SpecError, 3),
        ("nothing", SpecError, 3),
        ("empty.fbx", SpecError, 3),
        ("den.blend", BackendError, 6),
    ],
)
def test_files_that_cannot_be_imported_end_with_the_exit_code_of_the_cause(
    run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch, name: str, kind: type[PhotonfarmError], code: int
) -> None:
    monkeypatch.delenv(blender.VARIABLE, raising=False)
    monkeypatch.setenv("PATH", "")
    for made in ("notes.txt", "nothing", "den.blend"):
        Path(made).write_text(made)
    Path("empty.fbx").touch()
    error = run(name).exception
    assert isinstance(error, kind)
    assert error.exit_code == code
    assert name in str(error)


def test_a_blender_that_fails_is_quoted_in_one_sentence(
    run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program = tmp_path / "blender"
    program.write_text("#!/bin/sh\necho Error: not a blend file\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setenv(blender.VARIABLE, str(program))
    Path("den.blend").write_text("den")
    error = run("den.blend").exception
    assert isinstance(error, SpecError)
    assert "not a blend file" in str(error)
    monkeypatch.setenv(blender.VARIABLE, "/no/blender")
    assert isinstance(run("den.blend").exception, BackendError)


@pytest.mark.skipif(not os.environ.get("PHOTONFARM_BLENDER"), reason="PHOTONFARM_BLENDER names no Blender")
@pytest.mark.slow
def test_a_blend_file_is_imported_through_blender(
    quick: None, boxes: Path, run: Callable[..., Result], tmp_path: Path
) -> None:
    import subprocess

    script = f"""import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath={str(boxes)!r})
bpy.ops.wm.save_as_mainfile(filepath={str(tmp_path / "den.blend")!r})
"""
    (tmp_path / "make.py").write_text(script)
    command = blender.blender_command(tmp_path / "den.blend")
    place = next(number for number, word in enumerate(command) if word.endswith("blender_export.py"))
    subprocess.run([*command[:place], str(tmp_path / "make.py")], check=True)
    assert run(tmp_path / "den.blend").exit_code == 0
    assert "Table" in [group.name for group in load_spec("den.toml").groups]


def test_a_light_is_added_to_a_room_that_the_sun_does_not_reach(
    quick: None, case: Callable[[str], Path], run: Callable[..., Result]
) -> None:
    result = run(case("gltf-sun-outside-closed-room/scene.gltf"), "--out", "dark")
    assert result.exit_code == 0, result.output
    assert "one is added above what cameras see" in result.stdout
    spec = load_spec("dark.toml")
    assert [light.name for light in spec.lights] == ["ceiling-light"]
    assert spec.view.free_space is not None
    assert spec.exposure == pytest.approx(0.26, rel=0.15)


def test_no_camera_stands_in_a_cube_on_a_floor_which_gets_a_sky(
    quick: None, case: Callable[[str], Path], run: Callable[..., Result]
) -> None:
    result = run(case("gltf-cube-on-floor/scene.gltf"), "--out", "cube")
    assert result.exit_code == 0, result.output
    assert "white sky" in result.stdout
    spec, inside = load_spec("cube.toml"), np.array([[-0.5, 0, -0.5], [0.5, 1, 0.5]])
    origin = np.array([spec.view.origin.min, spec.view.origin.max])
    assert (origin[0] > inside[1]).any() or (origin[1] < inside[0]).any()
    scene = LoadedScene.load(spec, Path())
    view = sample_view(spec, rest(spec).key(spec.radiance_id), 1, 0)
    assert 0.2 < display_values(np.float32(spec.exposure) * scene.render_halves(view, (0,), 2)[0]).mean() < 0.8


@pytest.mark.parametrize(("scale", "shift", "unit"), [(1000, 0, "millimetres"), (1, 2000, None)])
def test_a_room_is_the_same_in_other_units_and_elsewhere(
    quick: None, gltf: Any, run: Callable[..., Result], scale: float, shift: float, unit: str | None
) -> None:
    for name, low, high, light in (
        ("Shell", (0, 0, 0), (5, 2.6, 4), 0),
        ("Table", (2, 0, 1.5), (3.2, 0.75, 2.2), 0),
        ("Lamp", (2, 2.5, 1.6), (2.6, 2.58, 2.2), 1),
    ):
        mesh = trimesh.creation.box(bounds=[low, high])
        if name == "Shell":
            mesh.invert()
        material = gltf.material(name, **({"emissiveFactor": [1, 1, 1]} if light else {}))
        vertices = (np.add(mesh.vertices, (shift, 0, 0)) * scale).astype("<f4")
        gltf.node(name, gltf.mesh(vertices, mesh.faces.astype("<u4"), material))
    result = run(gltf.write(), "--out", "it")
    assert result.exit_code == 0, result.output
    assert unit is None or f"lengths look like {unit}" in result.stdout
    spec = load_spec("it.toml")
    groups = {group.name: np.array([group.at, group.box.min, group.box.max]) / scale for group in spec.groups}
    moved = 2000 if shift == 2000 else 0
    table = groups["Table"] - [shift - moved, 0, 0]
    assert table[0] == pytest.approx([2.6, 0, 1.85], abs=2e-3)
    assert (table[1:] > [0.6, -1e-3, 0.35]).all()
    assert (table[1:] < [4.4, 1e-3, 3.65]).all()
    assert groups["Lamp"][:, 1] == pytest.approx(2.58, abs=2e-3)
    assert spec.exposure == pytest.approx(43.5, rel=0.2)  # from four frames in place of 48
    assert spec.view.near / scale == pytest.approx(0.0104, rel=0.05)


def test_messages_name_no_file_that_is_gone(run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise SpecError(f"{arguments[1]}/room-scene/scene.xml: line 3: is odd")

    monkeypatch.setattr(importer, "load", fail)
    Path("room.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert str(run("room.obj").exception) == "room-scene/scene.xml: line 3: is odd"
    assert [path.name for path in Path().iterdir()] == ["room.obj"]


SCENES = [Path(folder) for folder in os.environ.get("PHOTONFARM_SCENES", "").split(os.pathsep) if folder]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "groups"),
    [
        ("living-room-2", {"SofaLeather_0009", "SofaLeather_0003", "Table_0002"}),
        ("cornell-box", {"TallBox", "ShortBox", "Light"}),
    ],
)
def test_real_rooms_are_imported_without_their_ready_specs(
    quick: None, run: Callable[..., Result], scene: str, groups: set[str]
) -> None:
    found: Any = next((folder / scene / "scene.xml" for folder in SCENES if (folder / scene).is_dir()), None)
    if found is None:
        pytest.skip("PHOTONFARM_SCENES names no folder that has it")
    assert run(found).exit_code == 0
    assert groups <= {group.name for group in load_spec(f"{scene}.toml").groups}


def test_files_of_like_names_are_copied_apart(gltf: Any, read: Any, tmp_path: Path) -> None:
    for number, name in enumerate(("chair", "Chair", "Chair_2")):
        mesh = trimesh.creation.box(bounds=[(2 * number, 0, 0), (2 * number + 1, 1, 1)])
        gltf.node(name, gltf.mesh(mesh.vertices.astype("<f4"), mesh.faces.astype("<u4")))
    scene = read(gltf.write())
    scene.write_meshes(tmp_path / "meshes")
    importer._write_scene(scene, tmp_path / "it-scene")
    assert len({path.name.lower() for path in (tmp_path / "it-scene/meshes").iterdir()}) == 3
