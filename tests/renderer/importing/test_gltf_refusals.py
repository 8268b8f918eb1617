"""glTF files that are broken or ask for what is not supported are refused, with what is wrong by its name."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from imported_scenes import FOUR, Read

from photonfarm.core.errors import SpecError


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def changed(**entries: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        document = json.loads((folder / "room.gltf").read_text()) | entries
        (folder / "room.gltf").write_text(json.dumps(document))

    return change


@pytest.mark.parametrize(
    ("break_it", "named"),
    [
        (without("room.bin"), "room.bin"),
        (lambda folder: (folder / "room.bin").write_bytes(b"1234"), "needs"),
        (lambda folder: (folder / "four.png").write_bytes(b"no image"), "image 0"),
        (lambda folder: (folder / "room.gltf").write_text("{"), "room.gltf"),
        (lambda folder: (folder / "room.gltf").write_bytes(b"\xce{"), "is no glTF: it is neither JSON nor binary"),
        (changed(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
        (changed(extensionsRequired=["EXT_of_the_future"]), "EXT_of_the_future"),
        (
            changed(buffers=[{"byteLength": 4, "extensions": {"KHR_meshopt_compression": {"fallback": True}}}]),
            "KHR_meshopt_compression",
        ),
        (changed(nodes=[{"children": [1]}, {"children": [0]}], scenes=[{"nodes": [0]}]), "below itself"),
        (changed(asset={"version": "1.0"}), "1.0"),
        (changed(meshes=[]), "room.gltf"),
    ],
)
def test_what_cannot_be_read_is_named(
    gltf: Any, quad: Callable[..., Path], read: Read, tmp_path: Path, break_it: Callable[[Path], None], named: str
) -> None:
    path = quad(pbrMetallicRoughness={"baseColorTexture": gltf.image(FOUR, "four.png")})
    break_it(tmp_path)
    with pytest.raises(SpecError, match=named):
        read(path)


def first(kind: str, **entries: Any) -> Callable[[Any], None]:
    return lambda gltf: gltf.document[kind][0].update(entries)


@pytest.mark.parametrize(
    ("break_it", "named"),
    [
        (first("nodes", mesh=7), r"node 'Quad': names meshes\[7\], and the file has 1 meshes"),
        (first("nodes", rotation=[0, 0, 0, 0]), "node 'Quad': .*rotation"),
        (first("nodes", translation=[float("nan"), 0, 0]), "node 'Quad': .*translation"),
        (first("nodes", extensions={"KHR_lights_punctual": {"light": 4}}), r"node 'Quad': names lights\[4\]"),
        (first("materials", emissiveFactor=[1, 1]), "material 'paint': .*emissiveFactor"),
        (first("accessors", count=2), "node 'Quad': TEXCOORD_0 has 2 values where there are 4"),
        (first("accessors", type="SCALAR"), "node 'Quad': TEXCOORD_0 has 1 numbers a value"),
        (lambda gltf: gltf.document["meshes"][0]["primitives"][0].update(material=3), r"node 'Quad': names materials"),
        (lambda gltf: gltf.document["accessors"][-1].update(componentType=5126), "node 'Quad': indices"),
        (lambda gltf: gltf.document["meshes"][0]["primitives"][0].update(mode=7), "no triangles.*\n.*mode 7"),
        (lambda gltf: gltf.document.update(extensionsRequired="FOO"), "extensionsRequired has F, O, O"),
        (first("meshes", primitives={"mode": 4}), "node 'Quad': is not valid glTF"),
        (first("meshes", primitives=[{"attributes": []}]), "no POSITION"),
        (first("materials", extensions={"KHR_materials_specular": "x"}), "is not valid glTF"),
    ],
)
def test_what_is_wrong_is_told_with_its_node_and_its_key(
    gltf: Any, quad: Callable[..., Path], read: Read, break_it: Callable[[Any], None], named: str
) -> None:
    quad()
    break_it(gltf)
    with pytest.raises(SpecError, match=named):
        read(gltf.write())
