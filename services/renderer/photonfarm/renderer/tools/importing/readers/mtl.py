"""MTL files: their statements, the images that they name, and the Mitsuba material that is nearest to each."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal
from xml.etree.ElementTree import Element

import numpy as np
from PIL import Image as Pillow

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing import images
from photonfarm.renderer.tools.importing.changes import Changes, Effect
from photonfarm.renderer.tools.importing.surfaces import Map, UvTransform, Writer, constant

_CARRIED = re.compile(
    "(map_)?(kd|ke|d|pr|pm|ps|pc|aniso)|k[as]|n[si]|tr|tf|illum|sharpness|map_aat|pcr|anisor|norm|(map_)?bump"
)
"""What has its meaning here, or none where light and reflections are those of the scene."""

_PRINCIPLED = {"pr": "roughness", "pm": "metallic", "ps": "sheen", "pc": "clearcoat", "aniso": "anisotropic"}
"""Statements of which each, a number or an image, is a property of `principled`."""

_RELIEFS = ("norm", "map_bump", "bump")

_EFFECTS: dict[str, Effect | None] = {"disp": "geometry", "map_ka": None}  # of what is not carried over; else colour

_OPTION = re.compile(
    r"-(?:(type|imfchan)\s+(\S+)"
    r"|(\w+)((?:\s+(?:on|off|[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(?=\s)){0,3}))\s+",
    re.IGNORECASE,
)
"""An option before the name of an image: these two with a word, others with up to three of on, off and numbers.

A number ends at a space, as names of images may begin with digits.
"""

_CARRIED_OPTION = re.compile(
    r"(o|s|bm) [-+.\de ]*"  # `s 2 2 1`: carried over, with numbers
    r"|(clamp|blendu|blendv|boost|texres) .*"  # `clamp on`: carried over; `texres 512`: about filters
    r"|(?!(o|s|bm) )\w+ (off|[0. ]*)"  # `cc off`, `t 0 0 0`: any other that changes nothing
    r"|mm [0.]+ 1[0.]*"  # `mm 0 1.0`: a base of 0 and a gain of 1
)
"""The options, as `name values`, that have their meaning here, or none by what they speak of or by their values."""

_GLASS, _MIRRORS, _LIT = (4, 6, 7, 9), (3, 5, 8), range(1, 10)
"""The models of illumination that are glass, those that reflect the scene, and those of what light and shadows meet."""

_Kind = Literal["opaque", "mask", "hidden", "clear glass"]  # how light passes through a material
_Image = tuple[Path, UvTransform, float]  # a file, where a surface shows it, and the strength of its bumps

WHITE, _BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
_GREY = (0.7, 0.7, 0.7)  # the reflectance of what has no colour
_LEAST_ETA = 1.01  # the least index of refraction of `principled`, and here of glass

# These thresholds are ours; MTL has none
_SMOOTH = 0.2  # gloss up to this α is Mitsuba's `roughplastic`, which loses light above; `principled` gains some
_SHINES = 0.02  # gloss is modelled from this specular reflectance on
_TINTED = 0.1  # by so much of their largest the channels of a specular colour differ


def statements(file: Path) -> Iterator[tuple[int, str, str]]:
    """The line, first word and rest of each statement of a text; a backslash at a line's end joins the next to it."""
    try:
        data = file.read_bytes()
    except OSError as error:
        raise SpecError(f"{file}: cannot be read: {error.strerror or error}") from error
    try:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if "\0" in text:
        raise SpecError(f"{file}: is no text, and so no OBJ or MTL")
    lines = enumerate(re.split(r"\r\n?|\n", text), 1)
    for number, line in lines:
        while line.endswith("\\") and not line.lstrip().startswith("#"):
            line = f"{line[:-1]} {next(lines, (0, ''))[1]}"
        words = line.split(None, 1)
        if words and (words[0][0] != "#" or words[0] == "#MRGB"):
            yield number, words[0], words[1].rstrip() if len(words) > 1 else ""


def read_libraries(path: Path, stated: Sequence[str], changes: Changes) -> dict[str, Material]:
    """The materials of the `mtllib` statements of a file, by name; of two of one name the first is taken."""
    materials: dict[str, Material] = {}
    files: list[Path] = []
    for text in stated:  # one name, which may have spaces, or several
        for name in [text] if _locate(path.parent, text, changes) else text.split():
            if file := _locate(path.parent, name, changes):
                files.append(file)
            else:
                changes.lose("colour", "mtllib", "material files are not there", text)
    for file in dict.fromkeys(files):
        material: Material | None = None
        for line, word, rest in statements(file):
            if word.lower() == "newmtl":
                material = Material(rest, file, changes)
                if materials.setdefault(rest, material) is not material:
                    changes.note("is defined twice, and the first is taken", f"{file.name}: line {line}", name=rest)
            elif material is None or not rest:
                changes.note("has no material or no value, and means nothing", f"{file.name}: line {line}", name=word)
            else:
                if material.lines.get(word.lower(), (0, "", rest))[2] != rest:
                    material.say(None, word, "is stated twice, and the last is taken")
                material.lines[word.lower()] = (line, word, rest)
    return materials


def _locate(folder: Path, name: str, changes: Changes) -> Path | None:
    """The file of a name, or else the one of its last part in the folder, as paths may be those of another machine."""
    file = _find(folder, name)
    if file is None and (last := re.split(r"[/\\]", name.strip("\"'"))[-1]) and (file := _find(folder, last)):
        changes.note(f"'{name}' is not there; '{file.name}' beside the file is taken")
    return file


def _find(folder: Path, name: str) -> Path | None:
    """The file of a name, which may have the separators of Windows, quotes and other capitals."""
    file = folder
    try:
        for part in Path(name.strip("\"'").replace("\\", "/")).parts:
            named = [part] if (file / part).exists() else [each.name for each in file.iterdir()]
            file /= next(each for each in named if each.lower() == part.lower())
    except (StopIteration, OSError):
        return None
    return file if file.is_file() else None


def _is_plain(file: Path) -> bool:
    """Whether Mitsuba reads an image as it is; of other formats and modes it misreads some without a word."""
    with suppress(OSError, ValueError, SyntaxError), Pillow.open(file) as image:
        return image.format in ("PNG", "JPEG") and image.mode in ("L", "RGB", "RGBA")
    return False


def _floats(options: Mapping[str, str], name: str) -> list[float]:
    """The numbers of an option; words in their place are said where it is read."""
    return [float(word) for word in options.get(name, "").split() if word not in ("on", "off")]


def _read_uv_transform(options: Mapping[str, str]) -> UvTransform:
    """Where a surface shows an image: MTL's s·v + o goes upwards, so that v downwards becomes 1 − (s·(1 − v) + o)."""
    (su, sv), (u, v) = [*_floats(options, "s"), 1.0, 1.0][:2], [*_floats(options, "o"), 0.0, 0.0][:2]
    wrap = "clamp" if options.get("clamp") == "on" else "repeat"
    return UvTransform(((su, 0, u), (0, sv, 1 - sv - v)), (wrap, wrap))


def _read_map(image: _Image, factor: Sequence[float]) -> Map:
    """An image's linear colours times a factor."""
    file, transform, _ = image
    values = images.decode(file.read_bytes(), str(file))[..., :3]
    return Map(images.linear(values) * np.array(factor, np.float32), transform)


def _decide_kind(illum: float, opacity: float, *, is_textured: bool, may_hide: bool) -> _Kind:
    """How light passes by `illum` and an opacity of `d` or 1 − `Tr`, which an image of opacities is multiplied with.

    Clear glass would show neither images nor colours of vertices, with which a material `is_textured`. It `may_hide` if
    an opacity of 0 is meant: exporters write `Tr 1`, or `d 0` of what shines or has images, for what is opaque.
    """
    if opacity == 1:
        return "opaque"
    if illum in _GLASS and not is_textured:
        return "clear glass"
    if opacity > 0:
        return "mask"
    return "hidden" if may_hide and not is_textured else "opaque"


@dataclass(slots=True, eq=False)
class Material:
    """One material: its lines, as (number, word, rest), by their first words in small letters."""

    name: str
    file: Path
    changes: Changes
    lines: dict[str, tuple[int, str, str]] = field(default_factory=dict)
    painted: bool = False  # its colour is that of vertices, their attribute `vertex_color`
    mirrored: bool = False  # its images lie mirrored

    @property
    def has_images(self) -> bool:
        """Whether it names images."""
        return any(key.startswith("map_") or key in _RELIEFS for key in self.lines)

    @property
    def relief(self) -> str:
        """The key of its normal map, or else of its bump map, or nothing."""
        return next((key for key in _RELIEFS if key in self.lines), "")

    def say(self, effect: Effect | None, name: str, meaning: str) -> None:
        """Say what a statement means that is not carried over, and what of the picture that changes, if anything."""
        self.changes.say(effect, name, meaning, f"material {self.name!r}")

    def put(self, top: Element, stem: Path) -> Element | None:
        """Make a Mitsuba material of an empty element, and images named from `stem` on; the emitter of what shines."""
        writer = Writer(stem, self.changes, f"material {self.name!r}")
        for key, (_, word, _) in self.lines.items():
            if not _CARRIED.fullmatch(key):
                self.say(_EFFECTS.get(key, "colour"), word, "is not carried over")
        illum = self._number("illum", 2)
        if illum not in _LIT:  # 10 is seen by its shadows alone
            meaning = f"is lit as by model {1 if illum == 0 else 2} here"
            self.say("colour" if illum == 10 else None, f"illum {illum:g}", meaning)
        kind, factor = self._decide_opacity(illum)
        opacity, glow = self._opacity(factor), self._glow()
        tint = self.cut("tf", WHITE, black_is_white=True) if opacity else WHITE
        if kind == "clear glass":
            glass = {"int_ior": self._eta(_LEAST_ETA), "specular_transmittance": constant(*tint)}
            writer.put_surface(top, "thindielectric", glass)
            self.say(None, "illum", "becomes clear glass without a thickness, of Ni and Tf; Ke shines in full")
            return writer.light(glow, None, "map_Ke")
        if illum in _GLASS:
            effect: Effect | None = None if {"d", "tr"} & set(self.lines) else "colour"  # illum 4 with d 1 is common
            self.say(effect, f"illum {illum:g}", "is of glass, and is not here, by its d, Tr or images")
        if min(tint) < 1:
            self.say("colour", "Tf", "does not tint the light that passes through")
        self._put_gloss(writer.put_layers(top, opacity, self._normals(writer)), illum, writer)
        return writer.light(glow, opacity, "map_Ke")

    def _numbers(self, key: str, otherwise: Sequence[float] = _BLACK) -> Sequence[float]:
        """The numbers of a line; one stands for all three."""
        line, word, rest = self.lines.get(key, (0, key, ""))
        words = [part for part in rest.partition("#")[0].split() if part.lower() != "-halo"]
        if not words:
            return otherwise
        try:
            values = [float(part) for part in words[: len(otherwise)]]
        except ValueError:  # such as `spectral` and `xyz`, which hardly any file has
            values = []
        values = values * len(otherwise) if len(values) == 1 else values
        if len(values) != len(otherwise) or not all(map(math.isfinite, values)):
            place = f"{self.file}: line {line}: material {self.name!r}"
            raise SpecError(f"{place}: {word} = {rest!r} is no number, or three")
        return values

    def _number(self, key: str, otherwise: float) -> float:
        return self._numbers(key, (otherwise,))[0]

    def cut(
        self, key: str, otherwise: Sequence[float], *, black_is_white: bool = False, is_light: bool = False
    ) -> list[float]:
        """The numbers of a line, cut to 0 to 1, of light to ≥ 0; all 0 are 1 if `black_is_white`. Both are said."""
        most = math.inf if is_light else 1.0
        values = self._numbers(key, otherwise)
        made: list[float] = np.clip(values, 0, most).tolist()
        if np.abs(np.subtract(made, values)).max() > 1e-3:  # more than rounding
            bounds = "is below 0, and is cut to that" if is_light else "is cut to what lies in 0 to 1"
            self.say("light" if is_light else "colour", self.lines[key][1], bounds)
        if black_is_white and max(made) <= 0:
            self.say(None, self.lines[key][1], "is black where black is not meant, and is taken for white")
            return list(WHITE)
        return made

    def image(self, key: str) -> _Image | None:
        """The image of a line; None if it is not there, which is said: by each call, but `Changes` keeps it once."""
        line, word, rest = self.lines.get(key, (0, key, ""))
        if not rest:
            return None
        options: dict[str, str] = {}
        while (option := _OPTION.match(rest)) and not _find(self.file.parent, rest):
            options[(option[1] or option[3]).lower()] = (option[2] or option[4]).strip().lower()
            rest = rest[option.end() :]
        file = _locate(self.file.parent, rest, self.changes)
        if file is None:
            self.changes.lose("colour", word, "images are not there", f"{self.file.name}: line {line}: {rest}")
            return None
        for name, value in options.items():
            if not _CARRIED_OPTION.fullmatch(f"{name} {value}"):
                self.say("colour", f"{word} -{name}", "is an option that is not carried over")
        return file, _read_uv_transform(options), [*_floats(options, "bm"), 1.0][0]

    @property
    def _is_textured(self) -> bool:
        return self.painted or any(self.image(key) for key in ("map_kd", "map_d"))

    def _glow(self) -> Map:
        """What it emits, by `Ke` and an image."""
        image = self.image("map_ke")
        ke = self.cut("ke", WHITE if image else _BLACK, black_is_white=image is not None, is_light=True)
        return _read_map(image, ke) if image else constant(*ke)

    def _opacity(self, factor: float) -> Map | None:
        """A factor times its image's own opacity, where that has some, or else brightness; None is opaque."""
        image = self.image("map_d")
        if image is None:
            return constant(factor) if factor < 1 else None
        file, transform, _ = image
        values = images.decode(file.read_bytes(), str(file), raw=True)
        grey = values[..., 3:] if values[..., 3].min() < 1 else values[..., :3].mean(axis=2, keepdims=True)
        return Map(np.float32(factor) * grey.clip(0, 1), transform)

    def _decide_opacity(self, illum: float) -> tuple[_Kind, float]:
        """How light passes through it, and its opacity, by which that of an image is multiplied."""
        d, tr = self.lines.get("d"), self.cut("tr", (0.0,))[0]
        opacity = self.cut("d", (1 - tr,))[0]
        if d and d[2].lower().startswith("-halo") and opacity < 1:
            self.say("colour", "d -halo", "is as opaque at its edges as in its middle")
        if d and "tr" in self.lines and abs(opacity + tr - 1) > 0.01:
            self.say(None, f"Tr {tr:g}", f"is left out, as d says how opaque it is: {opacity:g}")
        may_hide = d is not None and max(self._numbers("ke")) <= 0 and "map_ke" not in self.lines
        kind = _decide_kind(illum, opacity, is_textured=opacity < 1 and self._is_textured, may_hide=may_hide)
        if kind == "hidden":
            self.say(None, "d 0", "is not seen, as the file says")
        elif kind == "opaque" and opacity == 0:
            self.say(None, "d 0" if d else "Tr 1", "would be unseen by this, and is opaque")
        return kind, 1 if kind == "opaque" else opacity

    def _normals(self, writer: Writer) -> Map | None:
        """Its normal map; an image of heights is none, which is said."""
        word, stated = self.lines.get(self.relief, (0, "", ""))[1:]
        for other in _RELIEFS:
            if self.lines.get(other, (0, "", stated))[2] != stated:
                self.say("colour", self.lines[other][1], f"is left out beside {word}")
        image = self.image(self.relief)
        if image is None:
            return None
        file, transform, strength = image
        values = images.decode(file.read_bytes(), str(file), raw=True)[..., :3]
        if self.relief != "norm":
            directions = 2 * values - 1  # of length 1, and most of them upwards, by thresholds of ours
            are_long = np.abs(np.linalg.norm(directions, axis=2) - 1) < 0.1
            if are_long.mean() <= 0.9 or (directions[..., 2] - np.abs(directions[..., 0])).mean() <= 0.3:
                self.say("colour", word, "raises no bumps, as heights are left out; export a normal map")
                return None
            self.say(None, word, "has the colours of a normal map, and is taken for one")
        part = Map(values, transform, file if _is_plain(file) else None)
        return writer.normals(part, strength, f"{word} -s", mirrored=self.mirrored, from_flat=True)

    def _put_gloss(self, place: Element, illum: float, writer: Writer) -> None:
        """Put what lies below opacity: diffuse, with the gloss of plastic or without."""
        ks, colour = self._numbers("ks"), self._colour()
        is_pbr = any(key.removeprefix("map_") in _PRINCIPLED for key in self.lines)
        is_glossy = max(ks) > _SHINES and illum not in (0, 1)
        if not is_glossy and not is_pbr:
            writer.put_surface(place, "diffuse", {"reflectance": colour}, painted=self.painted)
            return
        alpha = max(math.sqrt(2 / (max(self._number("ns", 30.0), 0.0) + 2)), 0.02)
        is_plastic = alpha <= _SMOOTH and not (is_pbr or self.painted)
        if illum in _MIRRORS and not is_pbr:
            self.say("colour", f"illum {illum:g}", "reflects as plastic does here, and not as a mirror")
        if is_glossy:
            # `roughplastic` has the colour of Ks, which is left out beside `Pr` and its like
            is_tinted = max(ks) - min(ks) > _TINTED * max(ks) and not (is_plastic or is_pbr)
            said = "becomes the gloss of plastic, by Ns" + ", without its colour" * is_tinted
            self.say("colour" if is_tinted else None, "Ks", said)
        if is_plastic:
            tint = constant(*(max(part, 0) / max(ks) for part in ks))
            parts = {"diffuse_reflectance": colour, "alpha": constant(alpha), "specular_reflectance": tint}
            writer.put_surface(place, "roughplastic", parts)
        else:
            parts = {"base_color": colour, "roughness": constant(math.sqrt(alpha)), "eta": self._eta(1.5)}
            parts |= self._properties() if is_pbr else {}
            writer.put_surface(place, "principled", parts, painted=self.painted)

    def _properties(self) -> dict[str, Map]:
        """The properties of `principled` that it states, by numbers or images."""
        parts = {"clearcoat_gloss": constant(1 - self.cut("pcr", (0.0,))[0])}
        for key, name in _PRINCIPLED.items():
            image = self.image(f"map_{key}")
            if image:
                file, transform, _ = image
                parts[name] = Map(images.decode(file.read_bytes(), str(file), raw=True)[..., :1].clip(0, 1), transform)
                if self._number(key, 1) != 1:
                    self.say(None, self.lines[key][1], "is left out beside its image")
            elif key in self.lines:
                parts[name] = constant(self.cut(key, (0.0,))[0])
        if self._number("aniso", 0) and self._number("anisor", 0):
            self.say("colour", "anisor", "its gloss is not turned")
        return parts

    def _eta(self, otherwise: float) -> Map:
        """Its index of refraction; where it is too small, the least of glass, or 1.5 of gloss, which `Ks` states."""
        eta = self._number("ni", 1.5)
        if eta < _LEAST_ETA:
            self.say(None, f"Ni {eta:g}", f"is no index of what refracts, and is taken for {otherwise:g}")
        return constant(eta if eta >= _LEAST_ETA else otherwise)

    def _colour(self) -> Map:
        image = self.image("map_kd")
        kd = self.cut("kd", WHITE if image or self.painted else _GREY, black_is_white=bool(image or self.painted))
        if image is None:
            if "kd" not in self.lines and self.lines and not self.painted:
                self.say(None, "Kd", "is not there; the surface is grey")
            return constant(*kd)
        file, transform, _ = image
        if min(kd) >= 1 and _is_plain(file):
            return Map(np.zeros((0, 0, 3), np.float32), transform, file)
        colour = _read_map(image, kd)
        if colour.values.max() > 1.001:
            self.say("colour", "map_Kd", "goes beyond 1, which no surface reflects, and is cut")
        return replace(colour, values=colour.values.clip(0, 1))
