"""glTF 2.0 containers: the JSON document, its extensions, its buffers, and the arrays and images in them."""

from __future__ import annotations

import base64
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing.changes import Changes, Effect
from photonfarm.renderer.tools.importing.meshes import Floats

Node = Mapping[str, Any]

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}

_READ = frozenset(
    {
        "EXT_mesh_gpu_instancing",
        "EXT_texture_avif",
        "EXT_texture_webp",
        "KHR_lights_punctual",
        "KHR_mesh_quantization",
        "KHR_materials_clearcoat",
        "KHR_materials_emissive_strength",
        "KHR_materials_ior",
        "KHR_materials_pbrSpecularGlossiness",
        "KHR_materials_specular",
        "KHR_materials_transmission",
        "KHR_materials_volume",
        "KHR_node_visibility",
        "KHR_texture_transform",
        "MSFT_texture_dds",
    }
)
"""The extensions that are carried over; what of one is not is said where it is read."""

_HARMLESS = (
    "AGI_",
    "EXT_instance_features",
    "EXT_mesh_features",
    "EXT_structural_metadata",
    "FB_geometry_metadata",
    "KHR_animation_pointer",
    "KHR_audio",
    "KHR_implicit_shapes",
    "KHR_interactivity",
    "KHR_materials_variants",
    "KHR_node_hover",
    "KHR_node_select",
    "KHR_physics",
    "KHR_xmp",
    "MSFT_lod",
    "MSFT_packing",
    "OMI_collider",
    "OMI_physics",
    "VRMC_node_constraint",
    "VRMC_springBone",
)
"""How the names of those begin that leave a picture of what is shown first as it is."""

_OF_TYPES: dict[str, type] = {
    **dict.fromkeys(
        (
            "accessors",
            "buffers",
            "bufferViews",
            "children",
            "extensionsRequired",
            "images",
            "materials",
            "meshes",
            "nodes",
            "primitives",
            "samplers",
            "scenes",
            "textures",
        ),
        list,
    ),
    **dict.fromkeys(("asset", "attributes", "extensions", "pbrMetallicRoughness", "sparse"), dict),
}
"""Keys that hold others, and what they are in JSON."""

COMPRESSED = {"EXT_meshopt_compression", "KHR_draco_mesh_compression", "KHR_meshopt_compression", "KHR_texture_basisu"}
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
        self._buffers: dict[int, bytes] = {}
        with self.at():
            self.document, self._binary = _open(path)
            version = str(self.document.get("asset", {}).get("version", "unknown"))
            if not version.startswith("2."):
                raise SpecError(f"is glTF of version {version!r}; only version 2 is read")
            _check_types({key: value for key, value in self.document.items() if key in _OF_TYPES})
            required = [name for name in self.all("extensionsRequired") if "KHR_materials_" not in name]
            refused = ", ".join(sorted(_unknown(required)))  # those of materials are said of each
            if refused:
                raise SpecError(f"extensionsRequired has {refused}, which is not read; export without it")
            for name in _unknown(self.document.get("extensions", ())):
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

    def all(self, kind: str) -> list[Any]:
        """The entries of one array of the document, such as meshes."""
        entries: list[Any] = self.document.get(kind, [])
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
            if name.startswith(_HARMLESS):
                self.changes.note("leaves a picture of what is shown first as it is", place, name=name)
            elif name not in _READ | COMPRESSED and (name not in _ZEROS or np.any(value.get(_ZEROS[name], 0))):
                self.changes.lose("light" if "light" in name else effect, name, "is not carried over", place)
        for key, value in entry.items():
            if isinstance(value, dict) and key != "extras":
                self.report(value, effect, place)

    def _buffer(self, number: int) -> bytes:
        if number not in self._buffers:
            entry = self.entry("buffers", number)
            self.report(entry, "geometry", f"buffer {number}")
            if "uri" in entry:
                data = self._read(entry["uri"], f"buffer {number}")
            elif number == 0 and self._binary:
                data = self._binary
            else:
                why = ", ".join(entry.get("extensions", ())) or "no binary chunk"
                raise SpecError(f"buffer {number} has no uri, and {why} in its place; export without compression")
            if len(data) < entry["byteLength"]:
                raise SpecError(f"buffer {number} is cut off: it has {len(data)} bytes and needs {entry['byteLength']}")
            self._buffers[number] = data
        return self._buffers[number]

    def _read(self, uri: str, what: str) -> bytes:
        if uri.startswith("data:"):
            if ";base64," not in uri[:100]:
                raise SpecError(f"{what} is in an uri that is not base64, which is not read")
            return base64.b64decode(uri.partition(",")[2])
        name = unquote(uri).replace("\\", "/")
        try:
            return (self.path.parent / name).read_bytes()
        except OSError as error:
            raise SpecError(f"{what}: {name!r} cannot be read: {error.strerror}; put it there") from error

    def _view(self, number: int, effect: Effect = "geometry") -> tuple[bytes, int]:
        """The bytes of a buffer view, and its stride."""
        view = self.entry("bufferViews", number)
        self.report(view, effect, f"buffer view {number}")
        start = view.get("byteOffset", 0)
        return self._buffer(view["buffer"])[start : start + view["byteLength"]], view.get("byteStride", 0)

    def array(self, number: int) -> NDArray[Any]:
        """The values of an accessor, (N, width): integers as they are, unless normalised to floats."""
        accessor = self.entry("accessors", number)
        self.report(accessor, "geometry", f"accessor {number}")
        width, kind = _WIDTHS[accessor["type"]], np.dtype(_TYPES[accessor["componentType"]])
        values = self._read_strided(accessor, kind, accessor["count"], width)
        if "sparse" in accessor:
            count, where, what = (accessor["sparse"][key] for key in ("count", "indices", "values"))
            rows = self._read_strided(where, np.dtype(_TYPES[where["componentType"]]), count, 1)
            values[rows[:, 0]] = self._read_strided(what, kind, count, width)
        return normalise(values) if accessor.get("normalized") else values

    def attribute(self, number: int, name: str, count: int, widths: Collection[int]) -> NDArray[Any]:
        """The values of an accessor (count, width) that is an attribute, whose width is one of some."""
        values = self.array(number)
        if len(values) != count:
            raise SpecError(f"{name} has {len(values)} values where there are {count}; export it anew")
        if values.shape[1] not in widths:
            allowed = " or ".join(map(str, widths))
            raise SpecError(f"{name} has {values.shape[1]} numbers a value; glTF has {allowed}")
        return values

    def _read_strided(self, entry: Node, kind: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        """Values in a buffer view (count, width); zeros without one."""
        if "bufferView" not in entry:
            return np.zeros((count, width), kind)
        (data, stride), start = self._view(entry["bufferView"]), entry.get("byteOffset", 0)
        step = stride or width * kind.itemsize
        needed = start + (count - 1) * step + width * kind.itemsize
        if count and len(data) < needed:
            raise SpecError(f"buffer view {entry['bufferView']} has {len(data)} bytes, and an accessor needs {needed}")
        return np.ndarray((count, width), kind, data, start, (step, kind.itemsize)).copy()

    def image(self, number: int) -> tuple[str, bytes | None]:
        """The name and the encoded bytes of an image; none, which is said, of a file that is not there."""
        entry = self.entry("images", number)
        self.report(entry, "colour", f"image {number}")
        name = str(entry.get("name") or unquote(entry.get("uri", "")))[:40]  # which may be the image itself
        if "bufferView" in entry:
            return name, self._view(entry["bufferView"], "colour")[0]
        try:
            return name, self._read(entry["uri"], f"image {number}")
        except SpecError as error:
            self.changes.lose("colour", "images", "are not there, so that their factors stand alone", str(error))
            return name, None


def extension(entry: Node, name: str) -> Node:
    """What an extension says of an entry."""
    entries: Node = entry.get("extensions", {}).get(name, {})
    return entries


def numbers(entry: Node, key: str, default: Sequence[float]) -> Floats:
    """What an entry has under a key: as many numbers as its default. Raises ValueError for anything else."""
    values = np.array(entry.get(key, default))
    if values.dtype.kind not in "if" or values.shape != np.shape(default) or not np.isfinite(values).all():
        raise ValueError(f"{key} is {entry.get(key)!r}; it must be {len(default)} numbers")
    return values.astype(np.float64)


def normalise(values: NDArray[Any]) -> NDArray[np.float64]:
    """Integers as fractions of the largest one of their kind; floats as they are."""
    if values.dtype.kind == "f":
        return values.astype(np.float64)
    return np.maximum(values / np.iinfo(values.dtype).max, -1.0)


def _unknown(names: Collection[str]) -> list[str]:
    """The extensions that may change the picture."""
    return [name for name in names if name not in _READ and not name.startswith(_HARMLESS)]


def _open(path: Path) -> tuple[dict[str, Any], bytes]:
    """The document of a file, and its binary chunk, which follows the document's in GLB."""
    data = path.read_bytes()
    text, binary = data, b""
    if data[:4] == b"glTF":
        end = 20 + int.from_bytes(data[12:16], "little")
        text, binary = data[20:end], data[end + 8 :]
    if not text.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        raise SpecError("is no glTF: it is neither JSON nor binary glTF")
    return json.loads(text), binary


def _check_types(entry: Node, place: str = "", of_all: type | None = None) -> None:
    """Raise SpecError for what holds others, in an entry and in all below it, and is not of the type that glTF has."""
    for key, value in entry.items():
        kind = of_all or _OF_TYPES.get(key, object)
        if not isinstance(value, kind):
            wanted = "a list" if kind is list else "an object"
            raise SpecError(f"{place}{key} is {str(value)[:60]}; it must be {wanted}")
        if of_all or key == "extras":
            continue
        if isinstance(value, dict):
            _check_types(value, f"{place}{key}.", dict if key == "extensions" else None)
        for number, each in enumerate(value if isinstance(value, list) else ()):
            if isinstance(each, dict):
                _check_types(each, f"{place}{key}[{number}].")
