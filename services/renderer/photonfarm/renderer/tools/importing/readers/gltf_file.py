"""glTF 2.0 containers: the JSON document, its extensions, its buffers, and the arrays and images in them."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing.changes import Changes, Effect
from photonfarm.renderer.tools.importing.imported import Floats

Node = Mapping[str, Any]

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}

_READ = re.compile(
    "EXT_(mesh_gpu_instancing|texture_avif|texture_webp)|MSFT_texture_dds"
    "|KHR_(lights_punctual|mesh_quantization|node_visibility|texture_transform)"
    "|KHR_materials_(clearcoat|emissive_strength|ior|pbrSpecularGlossiness|specular|transmission|volume)"
)
"""The extensions that are carried over; what of one is not is said where it is read."""

_HARMLESS = re.compile(
    "(KHR_(animation_pointer|audio|implicit_shapes|interactivity|materials_variants|node_|physics|xmp)"
    "|EXT_(instance_features|mesh_features|structural_metadata)|MSFT_(lod|packing)|AGI_|FB_|OMI_|VRMC_).*"
)
"""Those that leave a picture of what is shown first as it is."""

_COMPRESSED = re.compile("(EXT|KHR)_meshopt_compression|KHR_draco_mesh_compression|KHR_texture_basisu")
"""Those that may have the same data uncompressed beside them, which is read then."""

_ZEROS = {
    "KHR_materials_anisotropy": "anisotropyStrength",
    "KHR_materials_diffuse_transmission": "diffuseTransmissionFactor",
    "KHR_materials_dispersion": "dispersion",
    "KHR_materials_iridescence": "iridescenceFactor",
    "KHR_materials_sheen": "sheenColorFactor",
}
"""Extensions of materials, and what of them is 0, or is not there, where they have no effect."""

_EFFECTS: dict[str, Effect] = {
    **dict.fromkeys(("images", "materials", "samplers", "textures"), "colour"),
    **dict.fromkeys(("lights", "scenes"), "light"),
}
"""What of the picture extensions of entries change; those of all others change the geometry."""


class GltfFile:
    """One glTF file with all that it names. Each entry that is read says what of its extensions is not carried over."""

    def __init__(self, path: Path, changes: Changes) -> None:
        self.path, self.changes = path, changes
        self._buffers: dict[int, bytes] = {}
        with self.at():
            self.document, self._binary = _open(path)
            version = str(self.document.get("asset", {}).get("version", "unknown"))
            if not version.startswith("2."):
                raise SpecError(f"is glTF of version {version!r}; only version 2 is read")
            required = [name for name in self.all("extensionsRequired") if "KHR_materials_" not in name]
            if refused := ", ".join(sorted(_unknown(required))):  # those of materials are said of each
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
        name = entries[number].get("name")
        self._report(entries[number], _EFFECTS.get(kind, "geometry"), f"{kind[:-1]} {repr(name) if name else number}")
        return entries[number]

    def _report(self, entry: Node, effect: Effect, place: str) -> None:
        """Say which extensions of an entry, and of all in it, are not carried over."""
        for name, value in entry.get("extensions", {}).items():
            if _HARMLESS.fullmatch(name):
                self.changes.note("leaves a picture of what is shown first as it is", place, name=name)
            elif name in _ZEROS and not np.any(value.get(_ZEROS[name], 0)):
                continue
            elif not _READ.fullmatch(name) and not _COMPRESSED.fullmatch(name):
                self.changes.lose("light" if "light" in name else effect, name, "is not carried over", place)
        for key, value in entry.items():
            for each in value if isinstance(value, list) else [value]:
                if isinstance(each, dict) and key != "extras":
                    self._report(each, effect, place)

    def _buffer(self, number: int) -> bytes:
        if number not in self._buffers:
            entry = self.entry("buffers", number)
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

    def _view(self, number: int) -> tuple[bytes, int]:
        """The bytes of a buffer view, and its stride."""
        view = self.entry("bufferViews", number)
        start = view.get("byteOffset", 0)
        return self._buffer(view["buffer"])[start : start + view["byteLength"]], view.get("byteStride", 0)

    def array(self, number: int, name: str, widths: Collection[int], count: int | None = None) -> NDArray[Any]:
        """The values of an accessor (count, width): integers as they are, unless normalised to floats."""
        accessor = self.entry("accessors", number)
        if "sparse" in accessor or "bufferView" not in accessor:
            why = "sparse, or compressed, as by KHR_draco_mesh_compression"
            raise SpecError(f"{name} is {why}, which is not read; export it without")
        there, width = accessor["count"], _WIDTHS[accessor["type"]]
        if count not in (None, there):
            raise SpecError(f"{name} has {there} values where there are {count}; export it anew")
        if width not in widths:
            raise SpecError(f"{name} has {width} numbers a value; glTF has {' or '.join(map(str, widths))}")
        (data, stride), start = self._view(accessor["bufferView"]), accessor.get("byteOffset", 0)
        kind = np.dtype(_TYPES[accessor["componentType"]])
        step = stride or width * kind.itemsize
        needed = start + (there - 1) * step + width * kind.itemsize
        if there and len(data) < needed:
            raise SpecError(f"{name}: its buffer view has {len(data)} bytes, and it needs {needed}")
        values = np.ndarray((there, width), kind, data, start, (step, kind.itemsize)).copy()
        return normalise(values) if accessor.get("normalized") else values

    def image(self, number: int) -> bytes | None:
        """The encoded bytes of an image; none, which is said, of a file that is not there."""
        entry = self.entry("images", number)
        if "bufferView" in entry:
            return self._view(entry["bufferView"])[0]
        try:
            return self._read(entry["uri"], f"image {number}")
        except SpecError as error:
            self.changes.lose("colour", "images", "are not there, so that their factors stand alone", str(error))
            return None


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


def normalise(values: NDArray[Any]) -> Floats:
    """Integers as fractions of the largest one of their kind; floats as they are."""
    if values.dtype.kind == "f":
        return values.astype(np.float64)
    return np.maximum(values / np.iinfo(values.dtype).max, -1.0)


def _unknown(names: Collection[str]) -> list[str]:
    """The extensions that may change the picture."""
    return [name for name in names if not _READ.fullmatch(name) and not _HARMLESS.fullmatch(name)]


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
