"""Files to import, made here: a room in glTF of several files, and functions that write small ones."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from imported_scenes import FOUR, SQUARE
from PIL import Image

from photonfarm.renderer.tools.importing.imported import ImportedScene
from photonfarm.renderer.tools.importing.loading import load
from photonfarm.renderer.tools.importing.proposal import surfaces
from photonfarm.renderer.tools.importing.readers import blender, reader_of

STRENGTH = "KHR_materials_emissive_strength"
QUAD = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
FACES = np.array([[0, 1, 2], [0, 2, 3]], "<u4")
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def box(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The vertices (8, 3) and faces (12, 3) of a box whose faces look outwards."""
    corners = np.array(
        [[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)],
        "<f4",
    )
    return corners, np.array([f for a, b, c, d in SIDES for f in ((a, b, c), (a, c, d))], "<u4")


class Gltf:
    """A glTF document with one buffer in a file of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.binary = folder, bytearray()
        lists = ("nodes", "meshes", "materials", "accessors", "bufferViews")
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        self.document |= {name: [] for name in lists}

    def array(self, values: np.ndarray, kind: str) -> int:
        """Add an accessor; its number."""
        codes = {"<f4": 5126, "<u4": 5125, "<u2": 5123, "|u1": 5121, "|i1": 5120}
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": values.nbytes}
        self.binary += values.tobytes()
        self.binary += bytes(-len(self.binary) % 4)
        self.document["bufferViews"].append(view)
        self.document["accessors"].append(
            {
                "bufferView": len(self.document["bufferViews"]) - 1,
                "componentType": codes[values.dtype.str],
                "count": len(values),
                "type": kind,
            }
        )
        return len(self.document["accessors"]) - 1

    def material(self, name: str, **entries: Any) -> int:
        """Add a material; its number."""
        self.document["materials"].append({"name": name, **entries})
        return len(self.document["materials"]) - 1

    def mesh(self, vertices: np.ndarray, faces: np.ndarray, material: int | None = None, **attributes: int) -> int:
        """Add a mesh of one primitive; its number."""
        primitive: dict[str, Any] = {"attributes": {"POSITION": self.array(vertices, "VEC3"), **attributes}}
        primitive["indices"] = self.array(faces.reshape(-1, 1), "SCALAR")
        if material is not None:
            primitive["material"] = material
        self.document["meshes"].append({"primitives": [primitive]})
        return len(self.document["meshes"]) - 1

    def node(self, name: str, mesh: int | None = None, **entries: Any) -> int:
        """Add a node to the scene; its number."""
        self.document["nodes"].append({"name": name, **({} if mesh is None else {"mesh": mesh}), **entries})
        self.document["scenes"][0]["nodes"].append(len(self.document["nodes"]) - 1)
        return len(self.document["nodes"]) - 1

    def image(self, pixels: np.ndarray, name: str) -> dict[str, int]:
        """Add an image file; the reference to it that a material holds."""
        Image.fromarray(pixels.astype(np.uint8)).save(self.folder / name)
        images, textures = (self.document.setdefault(key, []) for key in ("images", "textures"))
        images.append({"uri": name})
        textures.append({"source": len(images) - 1})
        return {"index": len(textures) - 1}

    def write(self, name: str = "room.gltf") -> Path:
        """Write the document and its buffer."""
        (self.folder / "room.bin").write_bytes(self.binary)
        self.document["buffers"] = [{"uri": "room.bin", "byteLength": len(self.binary)}]
        (self.folder / name).write_text(json.dumps(self.document))
        return self.folder / name


@pytest.fixture
def gltf(tmp_path: Path) -> Gltf:
    """An empty document."""
    return Gltf(tmp_path)


@pytest.fixture
def quad(gltf: Gltf) -> Callable[..., Path]:
    """Function (material) → a file with a unit square that faces +z, its texture's top at y = 1."""

    def make(**material: Any) -> Path:
        uv = gltf.array(np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4"), "VEC2")
        normal = gltf.array(np.tile(np.array([[0, 0, 1]], "<f4"), (4, 1)), "VEC3")
        gltf.node("Quad", gltf.mesh(QUAD, FACES, gltf.material("paint", **material), TEXCOORD_0=uv, NORMAL=normal))
        return gltf.write()

    return make


@pytest.fixture
def read(tmp_path: Path) -> Callable[[Path], ImportedScene]:
    """Function (file) → what its reader makes of it."""
    (tmp_path / "scratch").mkdir(exist_ok=True)
    return lambda path: reader_of(path)(path, tmp_path / "scratch", lambda _: None)


@pytest.fixture
def loaded(tmp_path: Path, read: Callable[[Path], ImportedScene]) -> Callable[[Path], tuple[ImportedScene, Any]]:
    """Function (file) → what its reader makes of it, and that as a Mitsuba scene."""

    def make(path: Path) -> tuple[ImportedScene, Any]:
        scene = read(path)
        return scene, load(scene, tmp_path / "scratch", lambda _: None)

    return make


def room_of_boxes(made: Gltf) -> Path:
    """A room of 5 × 4 × 2.6 with a table, a wardrobe named so, and two chairs that are one mesh; it has no light."""
    paint = made.material("paint", pbrMetallicRoughness={"baseColorFactor": [0.8, 0.8, 0.8, 1], "metallicFactor": 0})
    wood = made.material("wood", pbrMetallicRoughness={"baseColorFactor": [0.5, 0.3, 0.2, 1], "metallicFactor": 0})
    vertices, faces = box((0, 0, 0), (5, 2.6, 4))
    made.node("Shell", made.mesh(vertices, faces[:, ::-1].copy(), paint))
    made.node("Table", made.mesh(*box((2, 0, 1.5), (3.2, 0.75, 2.2)), wood))
    made.node("Wardrobe", made.mesh(*box((0.02, 0, 0.1), (0.6, 2, 1.3)), wood))
    first, second = box((1, 0, 3), (1.4, 0.9, 3.4)), box((3.5, 0, 3), (3.9, 0.9, 3.4))
    both = np.concatenate([first[0], second[0]]), np.concatenate([first[1], second[1] + 8]).astype("<u4")
    made.node("Chairs", made.mesh(*both, wood))
    return made.write()


@pytest.fixture(scope="session")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room of boxes, which no test changes."""
    return room_of_boxes(Gltf(tmp_path_factory.mktemp("boxes")))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quick render that is quicker."""
    from photonfarm.renderer.tools.measure import exposure

    monkeypatch.setattr(exposure, "PATHS", 1 << 13)
    monkeypatch.setattr(exposure, "SIDE", 32)
    monkeypatch.setattr(exposure.propose, "__kwdefaults__", exposure.propose.__kwdefaults__ | {"frames": 4})


@pytest.fixture
def case() -> Callable[[str], Path]:
    """Function (name, such as `obj-concave/it.obj`) → a file of the import cases, which lie beside the checkout."""

    def make(name: str) -> Path:
        file = Path(__file__).resolve().parents[3].parent / "shared/cases/import" / name
        if not file.exists():
            pytest.skip(f"{name} is not there")
        return file

    return make


@pytest.fixture
def run(tmp_path: Path) -> Callable[..., None]:
    """Function (script, arguments) → lets Blender's Python run it; without Blender, its tests are skipped."""
    if not os.environ.get(blender.VARIABLE):
        pytest.skip(f"{blender.VARIABLE} names no Blender")

    def call(script: str, *arguments: str) -> None:
        (tmp_path / "script.py").write_text(script)
        command = blender.blender_command(tmp_path / "it.blend")
        place = next(number for number, word in enumerate(command) if word.endswith("blender_export.py"))
        command = [*command[:place], str(tmp_path / "script.py"), *arguments]
        made = subprocess.run(command, capture_output=True, check=False)
        assert made.returncode == 0, made.stderr.decode()[-1000:]

    return call


@pytest.fixture
def write_obj(tmp_path: Path) -> Callable[[str, str], Path]:
    """Function (faces, materials) → an OBJ file, with images beside it."""
    Image.fromarray(FOUR.astype(np.uint8)).save(tmp_path / "four.png")
    for name, value in (("full.png", 255), ("none.png", 0)):
        Image.fromarray(np.full((2, 2), value, np.uint8)).save(tmp_path / name)

    def make(faces: str, materials: str) -> Path:
        (tmp_path / "it.mtl").write_text(materials)
        (tmp_path / "it.obj").write_text(f"mtllib it.mtl\n{SQUARE}{faces}\n")
        return tmp_path / "it.obj"

    return make


@pytest.fixture
def obj(tmp_path: Path) -> Callable[[str | bytes], Path]:
    """Function (text) → an OBJ file."""

    def make(text: str | bytes) -> Path:
        (tmp_path / "it.obj").write_bytes(text if isinstance(text, bytes) else text.encode())
        return tmp_path / "it.obj"

    return make


@pytest.fixture
def write_xml(tmp_path: Path) -> Callable[..., Path]:
    """Function (content, version) → a scene file."""

    def make(content: str, version: str = "3.0.0") -> Path:
        (tmp_path / "scene.xml").write_text(f'<scene version="{version}">\n{content}\n</scene>')
        return tmp_path / "scene.xml"

    return make


@pytest.fixture
def few_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the points on surfaces, which is quicker."""
    monkeypatch.setattr(surfaces, "SAMPLES_PER_CELL", 1.3)


@pytest.fixture
def put(gltf: Any) -> Callable[..., None]:
    """Function (name, low, high, light, inwards) → adds a box, or a panel that faces down if it is flat."""

    def add(name: str, low: Any, high: Any, *, light: float = 0, inwards: bool = False) -> None:
        mesh = trimesh.creation.box(bounds=[low, np.add(high, (0, low[1] == high[1], 0))])
        if low[1] == high[1]:
            mesh.update_faces(mesh.face_normals[:, 1] < -0.5)
        if inwards:
            mesh.invert()
        look = {"emissiveFactor": [1, 1, 1], "extensions": {STRENGTH: {"emissiveStrength": light}}} if light else {}
        material = gltf.material(name, doubleSided=True, **look)
        gltf.node(name, gltf.mesh(mesh.vertices.astype("<f4"), mesh.faces.astype("<u4"), material))

    return add


@pytest.fixture
def room(put: Callable[..., None]) -> None:
    """A closed room of 5 × 4 × 2.6 with a table."""
    put("Shell", (0, 0, 0), (5, 2.6, 4), inwards=True)
    put("Table", (2, 0, 1.5), (3.2, 0.75, 2.2))
