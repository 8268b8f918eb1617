"""Scenes of Mitsuba 3 as they are imported, beside what Mitsuba itself loads of the same files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from imported_scenes import Loaded
from PIL import Image

RED = '<bsdf type="diffuse" id="{}"><rgb name="reflectance" value="0.3 .2 .1"/></bsdf>'
IMAGE = '<texture type="bitmap" name="{}"><string name="filename" value="images/a.png"/></texture>'

FILES = {
    "parts/in.xml": '<scene version="3.0.0"><default name="c" value="0.1"/><include filename="deep.xml"/>'
    f"{RED.format('in')}</scene>",
    "parts/deep.xml": '<scene version="2.1.0"><shape type="sphere"><float name="radius" value="$c"/></shape></scene>',
    "parts/one.xml": '<bsdf version="3.0.0" type="diffuse"><rgb name="reflectance" value="0.9 0.1 0.4"/></bsdf>',
    "meshes/t.obj": "v -1 -1 0\nv 1 -1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n",
    "s.spd": "400 0.2\n500 0.6\n700 0.9\n",
}
"""What the scenes name."""


def square(content: str) -> str:
    return f'<shape type="rectangle" id="Square">{content}</shape>'


SCENES = {
    "defaults": '<default name="w" value="3"/><default name="width" value="2"/>'
    + square('<transform name="to_world"><scale x="$width" y="$w"/></transform>'),
    "includes": '<default name="c" value="0.5"/><default name="f" value="in"/><include filename="parts/$f.xml"/>'
    + square('<ref id="in"/>'),
    "an included object": square('<include filename="parts/one.xml"/>'),
    "paths": '<path value="meshes"/><shape type="obj"><string name="filename" value="t.obj"/></shape>',
    "aliases": RED.format("a") + '<alias id="a" as="b"/><alias id="b" as="c"/>' + square('<ref id="c"/>'),
    "what comes later": square('<ref id="a"/>') + RED.format("a"),
    "what is in another shape": f'<shape type="sphere">{RED.format("m")}</shape>' + square('<ref id="m"/>'),
    "an image": square(f'<bsdf type="diffuse">{IMAGE.format("reflectance")}</bsdf>'),
    "a blend": square(
        f'<bsdf type="blendbsdf"><float name="weight" value="0.3"/>{RED.format("x")}<bsdf type="diffuse"/></bsdf>'
    ),
    "a normal map": square(f'<bsdf type="normalmap">{IMAGE.format("normalmap")}<bsdf type="diffuse"/></bsdf>'),
    "transforms": square(
        '<transform name="to_world"><translate x="1"/><rotate y="1" angle="30"/><scale value="2"/>'
        '<matrix value="1 0 0 0.1 0 1 0 0.2 0 0 1 0.3 0 0 0 1"/></transform>'
    ),
    "a sampled spectrum": square('<bsdf type="diffuse"><spectrum name="reflectance" value="400:.1, 700:.3"/></bsdf>'),
    "a spectrum of a file": square('<bsdf type="diffuse"><spectrum name="reflectance" filename="s.spd"/></bsdf>'),
    "an area light": square('<emitter type="area"><rgb name="radiance" value="2 3 4"/></emitter>'),
    "a spot": square("") + '<emitter type="spot"><transform name="to_world"><lookat origin="0 0 2" target="0 0 0" '
    'up="0 1 0"/></transform><rgb name="intensity" value="9"/></emitter>',
    "an image of the sky": square("") + '<emitter type="envmap"><string name="filename" value="images/a.png"/>'
    '<transform name="to_world"><rotate x="1" angle="90"/></transform></emitter>',
}


def facts(scene: Any) -> list[np.ndarray]:
    """Bounds, surfaces below a grid of rays, their materials, and the light that reaches a point."""
    import drjit as dr

    across = np.stack(np.meshgrid(np.linspace(-0.9, 0.9, 7), np.linspace(-0.9, 0.9, 6)), axis=-1).reshape(-1, 2)
    origin = mi.Point3f(across[:, 0], across[:, 1], np.full(len(across), 9.0))
    hit = scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, -1)))
    towards = dr.normalize(mi.Vector3f(0.3, 0.2, 1))
    found = [np.array(scene.bbox().min), np.array(scene.bbox().max), np.array(hit.is_valid()), np.array(hit.t)]
    found += [np.array(hit.bsdf().eval(mi.BSDFContext(), hit, towards)), np.array(hit.emitter(scene).eval(hit))]
    for emitter in scene.emitters():
        at = dr.zeros(mi.Interaction3f, 1)
        at.p = mi.Point3f(0.1, 0.2, 0.3)
        sample, weight = emitter.sample_direction(at, mi.Point2f(0.3, 0.6))
        found += [np.array(sample.d), np.array(weight)]
    return found


@pytest.mark.parametrize("name", SCENES)
def test_an_import_is_what_mitsuba_loads(tmp_path: Path, loaded: Loaded, name: str) -> None:
    for file, text in FILES.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
    (tmp_path / "images").mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (8, 16, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "images/a.png")
    sky = "" if "<emitter" in SCENES[name] else '<emitter type="constant"/>'
    file = tmp_path / "it.xml"
    file.write_text(f'<scene version="3.0.0">{SCENES[name]}{sky}</scene>')
    ours, theirs = loaded(file)[1], mi.load_file(str(file), optimize=False)
    assert len(ours.shapes()) == len(theirs.shapes())
    for one, other in zip(facts(ours), facts(theirs), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
