"""What `photonfarm infer` leaves in a folder: its files, and frame.json, which says what they show and names them."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Self

from photonfarm.core.errors import store_errors
from photonfarm.core.files import whole_file

MADE = re.compile(
    r"(prediction|truth|difference|comparison|target|frame-\d{4})\.png|frame\.(npz|exr|json)|path\.(gif|mp4)", re.ASCII
)
"""The names of all files that `infer` may make."""

ABOUT = "frame.json"
"""The file that says what is shown, and which files it is in."""

FOLDERS = "frame-" + 4 * "[0-9]"
"""The names of the folders that it makes, one for each of several configurations."""


@dataclass(frozen=True, slots=True)
class InferResult:
    """The files that were written, what is said of them, and what frame.json holds."""

    files: tuple[Path, ...]
    sentence: str
    about: Mapping[str, Any]

    @classmethod
    def write(cls, out: Path, files: Iterable[Path], sentence: str, **about: Any) -> Self:
        """Write frame.json beside the other files. Raises StoreError if the disk refuses."""
        made = *files, out / ABOUT
        document = {**about, "files": [file.name for file in made]}
        with store_errors("write what is shown", out / ABOUT), whole_file(out / ABOUT) as part:
            part.write_text(json.dumps(document, indent=1) + "\n")
        return cls(made, sentence, document)

    def document(self) -> dict[str, Any]:
        """What frame.json holds, with the paths of the files, for JSON."""
        return {**self.about, "files": list(map(str, self.files))}


def list_made(out: Path) -> set[Path]:
    """The files that earlier calls have made in a folder, as each frame.json there says."""
    found = set()
    for about in (out / ABOUT, *out.glob(f"{FOLDERS}/{ABOUT}")):
        with suppress(OSError, ValueError, LookupError, TypeError):  # not one of ours
            found |= {about.parent / name for name in json.loads(about.read_bytes())["files"] if MADE.fullmatch(name)}
    return found


def remove_made(files: Iterable[Path], read: Collection[Path]) -> list[Path]:
    """Remove files of an earlier call, as they show other things, and their folders if they were all that is there.

    What this call has read stays. Returns what was removed. Raises StoreError if that is refused.
    """
    removed = []
    for file in sorted(files):
        with store_errors("remove a file of an earlier call", file):
            if file.is_file() and not any(map(file.samefile, read)):
                file.unlink()
                removed.append(file)
                if fnmatch(file.parent.name, FOLDERS) and not any(file.parent.iterdir()):
                    file.parent.rmdir()
    return removed
