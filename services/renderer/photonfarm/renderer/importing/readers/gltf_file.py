"""glTF 2.0 containers: the JSON document, its extensions, its buffers, and the arrays and images in them."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.importing.changes import Changes, Effect
from photonfarm.renderer.importing.meshes import Floats
from photonfarm.shared.core.errors import SpecError

Node = Mapping[str, Any]

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942

READ = frozenset(
    {"EXT_mesh_gpu_instancing", "EXT_texture_avif", "EXT_texture_webp", "KHR_lights_punctual", "KHR_mesh_quantization",
     "KHR_materials_clearcoat", "KHR_materials_emissive_strength", "KHR_materials_ior",
     "KHR_materials_pbrSpecularGlossiness", "KHR_materials_specular", "KHR_materials_transmission",
     "KHR_materials_volume", "KHR_node_visibility", "KHR_texture_transform", "MSFT_texture_dds"}
)  # fmt: skip
"""The extensions that are carried over; what of one is not is said where it is read."""

HARMLESS = frozenset(
    {"AGI_articulations", "EXT_instance_features", "EXT_mesh_features", "EXT_structural_metadata",
     "FB_geometry_metadata", "KHR_animation_pointer", "KHR_audio", "KHR_audio_emitter", "KHR_implicit_shapes",
     "KHR_interactivity", "KHR_materials_variants", "KHR_node_hoverability", "KHR_node_selectability",
     "KHR_physics_rigid_bodies", "KHR_xmp", "KHR_xmp_json_ld", "MSFT_lod", "MSFT_packing_normalRoughnessMetallic",
     "MSFT_packing_occlusionRoughnessMetallic", "OMI_collider", "OMI_physics_body", "OMI_physics_joint",
     "OMI_physics_shape", "VRMC_node_constraint", "VRMC_springBone"}
)  # fmt: skip
"""Those that leave a picture of what is shown first as it is."""

COMPRESSED = frozenset(
    {"EXT_meshopt_compression", "KHR_draco_mesh_compression", "KHR_meshopt_compression", "KHR_texture_basisu"}
)
"""Those that may have the same data uncompressed beside them, which is read then."""

_ZEROS = {
    "KHR_materials_anisotropy": "anisotropyStrength",
    "KHR_materials_diffuse_transmission": "diffuseTransmissionFactor",
    "KHR_materials_dispersion": "dispersion",
    "KHR_materials_iridescence": "iridescenceFactor",
    "KHR_materials_sheen": "sheenColorFactor",
}
"""Extensions of materials, and what of them is 0 where they have no effect."""


class GltfFile:
    """One glTF file with all that it names."""

    def __init__(self, path: Path, changes: Changes) -> None:
        self.path, self.changes = path, changes
        self.document, self._binary = _opened(path)
        self._buffers: dict[int, bytes] = {}
        with self.at():
            version = str(self.document.get("asset", {}).get("version", "unknown"))
            if not version.startswith("2."):
                raise SpecError(f"is glTF of version {version!r}; only version 2 is read")
            refused = ", ".join(sorted({str(name) for name in self.all("extensionsRequired")} - READ - HARMLESS))
            if refused:
                raise SpecError(f"extensionsRequired has {refused}, which is not read; export without it")
            for name in sorted(set(self.document.get("extensions", ())) - READ - HARMLESS):
                changes.note("what the file as a whole has of it is not read", name=name)

    @contextmanager
    def at(self, place: str = "") -> Iterator[None]:
        """Name the file and a place, such as a node, in the errors of a block. Raises SpecError for what is no glTF."""
        where = f"{self.path}: {place}: " if place else f"{self.path}: "
        try:
            yield
        except SpecError as error:
            raise SpecError(where + str(error).removeprefix(f"{self.path}: ")) from error
        except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
            missing = " is missing, or no value that glTF has" if isinstance(error, KeyError) else ""
            raise SpecError(f"{where}is not valid glTF: {error}{missing}") from error

    def all(self, kind: str) -> list[Node]:
        """The entries of one array of the document, such as meshes."""
        entries: list[Node] = self.document.get(kind, [])
        if not isinstance(entries, list):
            raise SpecError(f"{kind} is {entries!r}; it must be a list")
        return entries

    def entry(self, kind: str, number: int, entries: Sequence[Node] | None = None) -> Node:
        """One entry of an array of the document, or of others of that kind."""
        entries = self.all(kind) if entries is None else entries
        if not isinstance(number, int) or not 0 <= number < len(entries):
            raise SpecError(f"names {kind}[{number!r}], and the file has {len(entries)} {kind}")
        return entries[number]

    def report(self, entry: Node, effect: Effect, place: str) -> None:
        """Say which extensions of an entry, and of all in it, are not carried over."""
        for name, value in entry.get("extensions", {}).items():
            if name in HARMLESS:
                self.changes.note("leaves a picture of what is shown first as it is", place, name=name)
            elif name not in READ | COMPRESSED and (name not in _ZEROS or np.any(value.get(_ZEROS[name], 0))):
                self.changes.lose("light" if "light" in name else effect, name, "is not carried over", place)
        for key, value in entry.items():
            if isinstance(value, dict) and key != "extras":
                self.report(value, effect, place)

    # ------------------------------------------------------------------------------------------------------- bytes

    def _buffer(self, number: int) -> bytes:
        if number not in self._buffers:
            entry = self.entry("buffers", number)
            self.report(entry, "geometry", f"buffer {number}")
            data = self._bytes_of(entry, number)
            if len(data) < entry["byteLength"]:
                raise SpecError(f"buffer {number} is cut off: it has {len(data)} bytes and needs {entry['byteLength']}")
            self._buffers[number] = data
        return self._buffers[number]

    def _bytes_of(self, entry: Node, number: int) -> bytes:
        if "uri" in entry:
            return self._read(entry["uri"], f"buffer {number}")
        if number == 0 and self._binary is not None:
            return self._binary
        compressed = ", ".join(entry.get("extensions", ()))
        why = f"{compressed} has its data, which is not read" if compressed else "the file has no binary chunk for it"
        raise SpecError(f"buffer {number} has no uri, and {why}; export the file without compression")

    def _read(self, uri: str, what: str) -> bytes:
        if uri.startswith("data:"):
            kind, _, words = uri.partition(",")
            return base64.b64decode(words) if kind.endswith(";base64") else unquote_to_bytes(words)
        name = unquote(uri).replace("\\", "/")
        try:
            return (self.path.parent / name).read_bytes()
        except OSError as error:
            reason = error.strerror or str(error)
            raise SpecError(f"{what}: {name!r} cannot be read: {reason}; put it there") from error

    def _view(self, number: int, effect: Effect = "geometry") -> tuple[bytes, int]:
        """The bytes of a buffer view, and its stride."""
        view = self.entry("bufferViews", number)
        self.report(view, effect, f"buffer view {number}")
        start, data = view.get("byteOffset", 0), self._buffer(view["buffer"])
        end = start + view["byteLength"]
        if end > len(data):
            raise SpecError(f"buffer {view['buffer']} has {len(data)} bytes; view {number} needs {end}")
        return data[start:end], view.get("byteStride", 0)

    def array(self, number: int) -> NDArray[Any]:
        """The values of an accessor, (N, width): integers as they are, unless normalised to floats."""
        accessor = self.entry("accessors", number)
        self.report(accessor, "geometry", f"accessor {number}")
        width, count = _WIDTHS[accessor["type"]], accessor["count"]
        kind = np.dtype(_TYPES[accessor["componentType"]])
        values = self._strided(accessor, kind, count, width)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            where = self._strided(sparse["indices"], np.dtype(_TYPES[sparse["indices"]["componentType"]]),
                                  sparse["count"], 1)  # fmt: skip
            values[where[:, 0]] = self._strided(sparse["values"], kind, sparse["count"], width)
        return normalised(values) if accessor.get("normalized") else values

    def attribute(self, number: int, name: str, count: int, widths: Collection[int]) -> NDArray[Any]:
        """The values of an accessor (count, width) that is an attribute, whose width is one of some."""
        values = self.array(number)
        if len(values) != count:
            raise SpecError(f"{name} has {len(values)} values where there are {count}; export it anew")
        if values.shape[1] not in widths:
            allowed = " or ".join(map(str, widths))
            raise SpecError(f"{name} has {values.shape[1]} numbers a value; glTF has {allowed}")
        return values

    def _strided(self, entry: Node, kind: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        """Values in a buffer view (count, width); zeros without one."""
        if "bufferView" not in entry:
            return np.zeros((count, width), kind)
        view, offset = entry["bufferView"], entry.get("byteOffset", 0)
        data, stride = self._view(view)
        step = stride or width * kind.itemsize
        needed = offset + (count - 1) * step + width * kind.itemsize
        if count and len(data) < needed:
            raise SpecError(f"buffer view {view} has {len(data)} bytes, and an accessor needs {needed}")
        return np.ndarray((count, width), kind, data, offset, (step, kind.itemsize)).copy()

    def image(self, number: int) -> tuple[str, bytes]:
        """The name and the encoded bytes of an image."""
        entry = self.entry("images", number)
        self.report(entry, "colour", f"image {number}")
        if "bufferView" in entry:
            return entry.get("name", f"image_{number}"), self._view(entry["bufferView"], "colour")[0]
        uri = entry["uri"]
        named = entry.get("name") or ("" if uri.startswith("data:") else Path(unquote(uri)).stem)
        return named or f"image_{number}", self._read(uri, f"image {number}")


def extension(entry: Node, name: str) -> Node:
    """What an extension says of an entry."""
    found: Node = entry.get("extensions", {}).get(name, {})
    return found


def numbers(entry: Node, key: str, default: Sequence[float]) -> Floats:
    """What an entry has under a key: as many numbers as its default. Raises ValueError for anything else."""
    values = np.array(entry.get(key, default))
    if values.dtype.kind not in "if" or values.shape != np.shape(default) or not np.isfinite(values).all():
        raise ValueError(f"{key} is {entry.get(key)!r}; it must be {len(default)} numbers")
    return values.astype(np.float64)


def normalised(values: NDArray[Any]) -> NDArray[np.float64]:
    """Integers as fractions of the largest one of their kind; floats as they are."""
    if values.dtype.kind == "f":
        return values.astype(np.float64)
    return np.maximum(values / np.iinfo(values.dtype).max, -1.0)


def _opened(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """The document of a file, and its binary chunk."""
    try:
        data = path.read_bytes()
        text, binary = _chunks(data) if data[:4] == b"glTF" else (data, None)
        document = json.loads(text)
    except (OSError, ValueError, struct.error) as error:
        raise SpecError(f"{path}: is not a readable glTF file: {error}") from error
    if not isinstance(document, dict):
        raise SpecError(f"{path}: is not a readable glTF file: its JSON is no object")
    return document, binary


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    found: dict[int, bytes] = {}
    place = 12
    while place + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, place)
        found.setdefault(kind, data[place + 8 : place + 8 + length])
        place += 8 + length
    if _JSON not in found:
        raise ValueError("it has no JSON chunk")
    return found[_JSON], found.get(_BINARY)
