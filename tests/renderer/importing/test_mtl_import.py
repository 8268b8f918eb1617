"""MTL as it is imported: materials, their images, and what of them is said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from imported_scenes import (
    COLOURS,
    CORNERS,
    FOUR_V,
    WHOLE,
    Loaded,
    Obj,
    Read,
    Write,
    area,
    emission,
    hit,
    lost,
    opacity,
    reflectance,
    said,
)
from PIL import Image

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing import images

LOST = ("map_Bump", "norm", "map_Tr", "Pr")


@pytest.mark.parametrize(
    ("lines", "kinds"),
    [
        ("Kd .5 .5 .5", ["TwoSided", "SmoothDiffuse"]),
        ("Kd .5 .5 .5\nKs .5 .5 .5\nNs 98\nillum 2", ["RoughPlastic", "alpha = [0.141"]),
        ("Kd .5 .5 .5\nKs .5 .5 .5\nNs 6\nillum 2", ["Principled", "roughness: UniformSpectrum[value=[0.707"]),
        ("Kd 1 1 1\nd 0.1\nNi 1.4\nillum 4", ["ThinDielectric", "eta = [1.39"]),
        ("Kd .5 .5 .5\nPr .3\nPm 1", ["Principled", "roughness: UniformSpectrum[value=[0.3", "metallic"]),
        ("Kd .5 .5 .5\nmap_Pr -s 2 2 four.png\nmap_Pm none.png", ["Principled", "roughness: Bitmap", "metallic: Bit"]),
        ("Kd .5 .5 .5\nd 0.8", ["Mask", "0.8"]),
        ("Kd .5 .5 .5\nmap_d four.png", ["Mask", "Bitmap"]),
    ],
)
def test_materials_become_what_is_nearest(
    write_obj: Callable[[str, str], Path], loaded: Loaded, lines: str, kinds: list[str]
) -> None:
    _, made = loaded(write_obj("usemtl it\nf 1/1 2/2 3/3 4/4", f"newmtl it\n{lines}"))
    for kind in kinds:
        assert kind in str(made.shapes()[0].bsdf())


def test_accepted_names_that_fit_nothing_are_said(write_obj: Write, read: Read) -> None:
    path = write_obj(WHOLE, "newmtl it\nmap_Kd gone.png")
    with pytest.raises(SpecError, match="--accept mapkd: nothing of that name differs here\n"):
        read(path).changes.refuse_unless(["mapkd"], "room.obj")
    for accepted in ("map_Kd", "MAP_KD", "Colour", "ALL"):
        read(path).changes.refuse_unless([accepted], "room.obj")


def test_transparency_beside_an_image_is_not_meant(case: Callable[[str], Path], loaded: Loaded) -> None:
    scene, made = loaded(case("mtl-tr-one/it.obj"))
    assert reflectance(made, 0.5, 0.4) == pytest.approx([0.462, 0.1, 0.021], abs=0.01)
    assert opacity(made, 0.5, 0.4) == 1
    assert "Tr 1" in said(scene)


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("Tr 1\nillum 4\nmap_Kd four.png", 1),
        ("d 0\nmap_Kd four.png", 1),
        ("Tr 1", 1),
        ("map_Ke four.png\nd 0", 1),
        ("d 0", 0),
        ("d 0.3", 0.3),
        ("Tr 0.3", 0.7),
        ("Tr 0.7\nillum 4\nmap_Kd four.png", 0.3),
        ("map_d none.png", 0),
        ("d 0.5\nmap_d full.png", 0.5),
    ],
)
def test_opacity_is_that_of_the_file(write_obj: Write, loaded: Loaded, lines: str, expected: float) -> None:
    scene, made = loaded(write_obj(WHOLE, f"newmtl it\nKd .5 .5 .5\n{lines}"))
    assert opacity(made, 0.25, 0.75) == pytest.approx(expected, abs=1e-3)
    assert not lost(scene)


def test_a_halo_of_one_is_opaque_and_another_is_said(
    case: Callable[[str], Path], write_obj: Write, loaded: Loaded
) -> None:
    _, made = loaded(case("mtl-halo/it.obj"))
    assert reflectance(made, 0.5, 0.4) == pytest.approx([1, 0, 0])
    assert opacity(made, 0.5, 0.4) == 1
    scene, _ = loaded(write_obj(WHOLE, "newmtl it\nKd 1 0 0\nd -halo 0.5"))
    assert lost(scene) == {"d -halo": "colour"}


@pytest.mark.parametrize(
    ("line", "expected"), [("Kd .3", (0.3, 0.3, 0.3)), ("Kd 1 0 0 # red", (1, 0, 0)), ("Ka 1 1 1", (0.7, 0.7, 0.7))]
)
def test_colours_in_each_form_are_read(
    write_obj: Write, loaded: Loaded, line: str, expected: tuple[float, ...]
) -> None:
    scene, made = loaded(write_obj(WHOLE, f"newmtl it\n{line}"))
    assert reflectance(made, 0.5, 0.4) == pytest.approx(expected, abs=1e-3)
    assert not lost(scene)


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("Kd 2 1 1", {"Kd": "colour"}),
        ("d 1.7", {"d": "colour"}),
        ("Ke -1 0 5", {"Ke": "light"}),
        ("Kd 1 1 1\nKs .3 .3 .3\nillum 3", {"illum 3": "colour"}),
        ("d 0.5\nTf 1 0 0", {"Tf": "colour"}),
        ("d 1\nTf 0 0 0", {}),
        ("map_Kd -mm 0 2 four.png", {"map_Kd -mm": "colour"}),
        ("map_Ke -o .5 0 four.png\nmap_d four.png", {"map_Ke": "light"}),
        ("map_Ks x.png\nrefl -type sphere x.png", {"map_Ks": "colour", "refl": "colour"}),
        ("Pr 1.7\nmap_Bump four.png\nnorm x.png\nmap_Tr x.png", dict.fromkeys(LOST, "colour")),
        ("map_Bump -bm 0.5 four.png", {"map_Bump": "colour"}),
        ("Ks .5 .1 .1\nPr .3\nPm 1\nPs 1\nPc 1\nPcr .1\naniso 0\nanisor 0", {}),
        ("map_Kd -s on -o 0 off four.png", {"map_Kd -s": "colour", "map_Kd -o": "colour"}),
        ("norm -bm on four.png", {"norm -bm": "colour"}),
        ("disp x.png", {"disp": "geometry"}),
        ("illum 10", {"illum 10": "colour"}),
        ("bogus 1", {"bogus": "colour"}),
        ("map_Kd -t 1 1 1 -cc on -foo 3 four.png", {f"map_Kd {name}": "colour" for name in ("-t", "-cc", "-foo")}),
        ("map_Ka x.png\nmap_aat on\nsharpness 60\nmap_Kd", {}),
    ],
)
def test_statements_of_materials_are_carried_over_or_said(
    write_obj: Write, loaded: Loaded, lines: str, expected: dict[str, str]
) -> None:
    scene, _ = loaded(write_obj(WHOLE, f"newmtl it\n{lines}"))
    assert lost(scene) == expected


@pytest.mark.parametrize(
    ("lines", "guess"),
    [
        ("Kd 0 0 0\nmap_Kd four.png", "Kd: is black where black is not meant, and is taken for white"),
        ("d 0.5\nTf 0 0 0", "Tf: is black where black is not meant"),
        ("illum 11", "illum 11: is lit as by model 2"),
        ("illum 4\nd 0\nKe 1 1 1", "Ke shines in full"),
        ("Pr 0.3\nmap_Pr four.png", "Pr: is left out beside its image"),
        ("illum 4\nd 0\nNi 1", "Ni 1: is no index of what refracts, and is taken for 1.01"),
    ],
)
def test_guesses_about_materials_are_said(write_obj: Write, read: Read, lines: str, guess: str) -> None:
    scene = read(write_obj(WHOLE, f"newmtl it\n{lines}"))
    assert guess in said(scene)
    assert not lost(scene)


@pytest.mark.parametrize("line", ["Kd 1 0", "Kd nan 0 0", "Kd spectral a.rfl 1", "Kd xyz 0.4 0.2 0", "d x"])
def test_numbers_of_materials_that_are_none_are_refused_with_their_line(
    write_obj: Write, read: Read, line: str
) -> None:
    with pytest.raises(SpecError, match=r"it.mtl: line 2: material 'it': (Kd|d) = "):
        read(write_obj(WHOLE, f"newmtl it\n{line}"))


@pytest.mark.parametrize(
    ("stated", "there"),
    [
        ("a b.mtl", ["a b.mtl"]),
        ("x.mtl\nmtllib y.mtl", ["x.mtl", "y.mtl"]),
        ("SUB\\Y.MTL", ["sub/y.mtl"]),
        ("C:\\my files\\y.mtl", ["y.mtl"]),
    ],
)
def test_material_files_are_found_by_all_their_names(
    tmp_path: Path, obj: Obj, loaded: Loaded, stated: str, there: list[str]
) -> None:
    for number, name in enumerate(there):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f"newmtl paint{number}\nKd {number} .5 1")
    last = len(there) - 1
    _, made = loaded(obj(f"mtllib {stated}\n{FOUR_V}usemtl paint{last}\nf 1 2 3 4"))
    assert reflectance(made, 0.5, 0.4) == pytest.approx([last, 0.5, 1])


def test_several_material_files_may_stand_on_a_line(case: Callable[[str], Path], loaded: Loaded) -> None:
    _, made = loaded(case("mtllib-two-on-a-line/it.obj"))
    assert reflectance(made, 0.7, 0.3) == pytest.approx([1, 0, 0])
    assert reflectance(made, 0.3, 0.7) == pytest.approx([0, 1, 0])


@pytest.mark.parametrize("name", ["mtl-texture-scale", "mtl-texture-scale-two-values"])
def test_images_are_scaled(case: Callable[[str], Path], loaded: Loaded, name: str) -> None:
    _, made = loaded(case(f"{name}/it.obj"))
    places = ((0.125, 0.875), (0.375, 0.875), (0.375, 0.625), (0.875, 0.375), (0.125, 0.625))
    for at, colour in zip(places, ("red", "green", "white", "green", "blue"), strict=True):
        assert reflectance(made, *at) == pytest.approx(COLOURS[colour], abs=0.01)


@pytest.mark.parametrize(
    ("options", "colours"),
    [
        ("-o .5", "green red white blue"),
        ("-o 0 .5 0 -s 1 1 1", "blue white red green"),
        ("-s -1 1", "green red white blue"),
        ("-clamp on -o 1 0", "green green white white"),
        ("-blendu off -boost 1 -texres 512 -t 0 0 0 -cc off -clamp off -mm 0 1.0", "red green blue white"),
    ],
)
def test_options_of_images_are_carried_over(write_obj: Write, loaded: Loaded, options: str, colours: str) -> None:
    scene, made = loaded(write_obj(WHOLE, f"newmtl it\nKd 1 1 1\nmap_Kd {options} four.png"))
    for at, colour in zip(CORNERS, colours.split(), strict=True):
        assert reflectance(made, *at) == pytest.approx(COLOURS[colour], abs=0.01)
    assert not lost(scene)


@pytest.mark.parametrize(
    ("stated", "there"),
    [
        ('"my tex.png"', "my tex.png"),
        ("Tex\\A.PNG", "tex/a.png"),
        ("C:\\Users\\x y\\a b.png", "a b.png"),
        ("maps/a.png", "a.png"),
        ("-s.png", "-s.png"),
        ("a.tif", "a.tif"),
    ],
)
def test_images_are_found_by_all_their_names(
    tmp_path: Path, write_obj: Write, loaded: Loaded, stated: str, there: str
) -> None:
    file = write_obj(WHOLE, f"newmtl it\nmap_Kd {stated}")
    (tmp_path / there).parent.mkdir(exist_ok=True)
    Image.open(tmp_path / "four.png").save(tmp_path / there)
    scene, made = loaded(file)
    assert reflectance(made, 0.25, 0.75) == pytest.approx([1, 0, 0], abs=0.01)
    assert ("beside the file" in said(scene)) == (("/" in stated or ":" in stated) and there == Path(there).name)


def test_images_beyond_1_are_cut_and_said(tmp_path: Path, write_obj: Write, loaded: Loaded) -> None:
    images.save_radiance(np.full((2, 2, 3), (2, 0.5, 0), np.float32), tmp_path / "two.exr")
    scene, made = loaded(write_obj(WHOLE, "newmtl it\nmap_Kd two.exr"))
    assert reflectance(made, 0.5, 0.4) == pytest.approx([1, 0.5, 0], abs=0.01)
    assert lost(scene) == {"map_Kd": "colour"}


def test_faces_without_texture_coordinates_are_said(write_obj: Write, loaded: Loaded) -> None:
    scene, made = loaded(write_obj("usemtl it\nf 1 2 3\nf 1/1 3/3 4/4", "newmtl it\nKd 1 1 1\nmap_Kd four.png"))
    assert reflectance(made, 0.25, 0.75) == pytest.approx([1, 0, 0], abs=0.01)
    assert "some faces have none" in said(scene)
    assert area(made) == pytest.approx(1)


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("Ke 4 4 4\nd 0.25", (1, 1, 1)),
        ("Ke 4 4 4\nTr 0.25", (3, 3, 3)),
        ("Ke 5 5 5\nmap_d none.png", (0, 0, 0)),
        ("Ke 2 3 4\nmap_Ke four.png", (2, 0, 0)),
        ("Ke 0 0 0\nmap_Ke -o .5 0 four.png", (0, 1, 0)),
        ("Ke 5 5 5\nmap_Ke four.png\nmap_d four.png", (5 / 3, 0, 0)),
        ("Kd 1 1 1\nKe 4 4 4\nillum 4\nd 0", (4, 4, 4)),
    ],
)
def test_surfaces_shine_as_far_as_they_are_opaque(
    write_obj: Write, loaded: Loaded, lines: str, expected: tuple[float, ...]
) -> None:
    scene, made = loaded(write_obj(WHOLE, f"newmtl it\n{lines}"))
    for side in (5, -5):
        assert emission(made, 0.25, 0.75, side) == pytest.approx(expected, rel=0.01, abs=0.01)
    assert not lost(scene)


def scattered(made: Any, *light: float) -> float:
    """What of light from a direction the square at (0.4, 0.3) sends upwards."""
    si = hit(made, 0.4, 0.3)
    towards = si.to_local(mi.Vector3f(*(part / float(np.linalg.norm(light)) for part in light)))
    return float(np.array(si.bsdf().eval(mi.BSDFContext(), si, towards)).ravel()[0])


NORMALS = {"right": (0.5, 0, 0.75**0.5), "up": (0, 0.5, 0.75**0.5)}


@pytest.mark.parametrize("lean", NORMALS)
@pytest.mark.parametrize(
    ("uv", "signs"),
    [
        ("vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n", (1, 1)),
        ("vt 1 0\nvt 0 0\nvt 0 1\nvt 1 1\n", (-1, 1)),
        ("vt 0 1\nvt 1 1\nvt 1 0\nvt 0 0\n", (1, -1)),
    ],
)
def test_normal_maps_lean_as_they_lie_also_mirrored(
    tmp_path: Path, write_obj: Write, obj: Obj, loaded: Loaded, lean: str, uv: str, signs: tuple[int, int]
) -> None:
    values = np.round(np.array(NORMALS[lean]) * 127.5 + 127.5).astype(np.uint8)
    Image.fromarray(np.tile(values, (4, 4, 1))).save(tmp_path / "n.png")
    for line in ("norm n.png", "map_Bump -bm 1.0 n.png"):
        write_obj("", f"newmtl it\nKd 1 1 1\n{line}")
        scene, made = loaded(obj(f"mtllib it.mtl\n{FOUR_V}{uv}usemtl it\nf 1/1 2/2 3/3 4/4"))
        axis = np.array([1, 0]) if lean == "right" else np.array([0, 1])
        towards = axis * np.array(signs)
        assert scattered(made, *towards.tolist(), 1.0) == pytest.approx(0.304, abs=0.003)
        assert scattered(made, *(-towards).tolist(), 1.0) == pytest.approx(0.081, abs=0.003)
        assert not lost(scene)
