"""MTL files: their statements, the numbers of these, and the images that they name."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from photonfarm.core.errors import SpecError
from photonfarm.renderer.tools.importing import images
from photonfarm.renderer.tools.importing.changes import Changes, Effect
from photonfarm.renderer.tools.importing.surfaces import Lie, Map

Meaning = tuple[Effect | None, str]
"""What of the picture a statement changes that is not carried over, if anything, and how."""

_OPTION = re.compile(
    r"-(?:(type|imfchan)\s+(\S+)|(\w+)((?:\s+(?:on|off|[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(?=\s)){0,3}))\s+",
    re.IGNORECASE,
)
"""An option before the name of an image: one word, or up to three numbers."""

_CARRIED = ("o", "s", "clamp", "bm", "blendu", "blendv", "boost", "texres")
"""The options that have their meaning here, or speak of how programs filter; others have none if 0 or off."""

RELIEFS = ("norm", "map_bump", "bump")
WHITE = (1.0, 1.0, 1.0)


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
    for file in dict.fromkeys(file for names in stated for file in _libraries(path.parent, names, changes)):
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
                    material.say((None, "is stated twice, and the last is taken"), word)
                material.lines[word.lower()] = (line, word, rest)
    return materials


def _libraries(folder: Path, stated: str, changes: Changes) -> Iterator[Path]:
    """The files of a statement, which may be several, and have spaces in their names."""
    words = stated.split()
    while words:
        ends = range(len(words), 0, -1)
        end = next((end for end in ends if _find(folder, " ".join(words[:end]))), len(words))
        if file := _locate(folder, " ".join(words[:end]), changes):
            yield file
        else:
            changes.lose("colour", "mtllib", "material files are not there", " ".join(words))
        words = words[end:]


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


@dataclass(slots=True, eq=False)
class Material:
    """One material: its lines, as (number, word, rest), by their first words in small letters."""

    name: str
    file: Path
    changes: Changes
    lines: dict[str, tuple[int, str, str]] = field(default_factory=dict)

    def number(self, key: str, otherwise: float) -> float:
        """The first number of a line."""
        return self.colour(key, (otherwise,))[0]

    def colour(self, key: str, otherwise: Sequence[float] = (0.0, 0.0, 0.0)) -> Sequence[float]:
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

    def cut(self, key: str, otherwise: Sequence[float], most: float = 1.0, effect: Effect = "colour") -> list[float]:
        """The numbers of a line from 0 to `most`, to which others are cut. Where `otherwise` is white, so is black."""
        values = self.colour(key, otherwise)
        made: list[float] = np.clip(values, 0, most).tolist()
        if np.abs(np.subtract(made, values)).max() > 1e-3:  # more than rounding
            bounds = "is below 0, and is cut to that" if most == math.inf else f"is cut to what lies in 0 to {most:g}"
            self.say((effect, bounds), self.lines[key][1])
        if tuple(otherwise) == WHITE and max(made) <= 0:
            self.say((None, "is black where black is not meant, and is taken for white"), self.lines[key][1])
            return list(WHITE)
        return made

    def image(self, key: str) -> Image | None:
        """The image of a line; None if it is not there, which is said."""
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
        made = Image(file, options)
        for name, value in options.items():
            if name in ("s", "o", "bm") and {"on", "off"} & set(value.split()):
                place = f"{self.file}: line {line}: material {self.name!r}"
                raise SpecError(f"{place}: {word} -{name} {value} is no number")
            if name not in _CARRIED and not _is_neutral(name, value):
                self.say(("colour", "is an option that is not carried over"), f"{word} -{name}")
        return made

    @property
    def has_images(self) -> bool:
        """Whether it names images."""
        return any(key.startswith("map_") or key in RELIEFS for key in self.lines)

    def say(self, meaning: Meaning, name: str) -> None:
        """Say what a statement means that is not carried over."""
        self.changes.say(meaning[0], name, meaning[1], f"material {self.name!r}")

    @property
    def relief(self) -> str:
        """The key of its normal map, or else of its bump map, or nothing."""
        return next((key for key in RELIEFS if key in self.lines), "")


def _is_neutral(name: str, value: str) -> bool:
    """Whether an option changes nothing."""
    try:
        numbers = [float(part) for part in value.split()]
    except ValueError:
        return value == "off"
    return numbers == ([0, 1] if name == "mm" else [0] * len(numbers))


@dataclass(frozen=True, slots=True)
class Image:
    """An image file, and the options that stand before its name, without their hyphens."""

    file: Path
    options: dict[str, str]

    @property
    def is_plain(self) -> bool:
        """Whether Mitsuba reads the file as it is; of other formats and modes it misreads some without a word."""
        with suppress(OSError, ValueError, SyntaxError), Pillow.open(self.file) as image:
            return image.format in ("PNG", "JPEG") and image.mode in ("L", "RGB", "RGBA")
        return False

    def triple(self, option: str, otherwise: float = 0.0) -> list[float]:
        """The numbers of an option, three or those that are missing `otherwise`."""
        return [*(float(part) for part in self.options.get(option, "").split()), *[otherwise] * 3][:3]

    def values(self, *, raw: bool = False) -> images.Image:
        """Its values as they are stored (H, W, 4)."""
        return images.decode(self.file.read_bytes(), str(self.file), raw=raw)

    def map(self, factor: Sequence[float] = WHITE, *, raw: bool = False) -> Map:
        """Its colours times a factor, linear unless raw."""
        if min(factor) >= 1 and self.is_plain:
            return Map(np.zeros((0, 0, 3), np.float32), self.lie, self.file)
        values = self.values(raw=raw)[..., :3]
        return Map((values.clip(0, 1) if raw else images.linear(values)) * np.array(factor, np.float32), self.lie)

    @property
    def lie(self) -> Lie:
        """How it lies. MTL's v goes upwards, and Mitsuba's downwards."""
        (su, sv, _), (u, v, _) = self.triple("s", 1.0), self.triple("o")
        wrap = "clamp" if self.options.get("clamp") == "on" else "repeat"
        return Lie(((su, 0, u), (0, sv, 1 - sv - v)), (wrap, wrap))
