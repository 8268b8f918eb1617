"""What all benchmarks do alike: their options, and their part of a page of docs/results with NAME.json, signed."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from photonfarm.core.formatting import format_markdown_table

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs/results"


def parser(about: str | None) -> argparse.ArgumentParser:
    """A parser with the option that every benchmark has; `about` is the docstring of its module."""
    os.environ.setdefault("PHOTONFARM_DEVICE", "cpu")  # figures of pages are processor seconds
    made = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--out", type=Path, default=FOLDER, help="folder for the Markdown and JSON (docs/results)")
    return made


def write(name: str, text: str, values: dict[str, Any], out: Path, page: str = "") -> None:
    """Save the part of bench/*/NAME.py, signed in its last line, in NAME.md or PAGE.md; its figures in NAME.json."""
    document = {"command": command(name), "commit": commit(), "machine": machine(), **values}
    save(page or name, f"{text}\n\n{footer(name)}", document, out, stem=name)


def save(page: str, text: str, document: dict[str, Any], out: Path, stem: str = "") -> None:
    """Write a part of PAGE.md into a folder, and its figures as STEM.json (PAGE.json); print the part.

    A page may hold several parts, each below a title of its own (`# …`). The part with this title is replaced, else the
    text is put at the end; the others stay.
    """
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{page}.md"
    parts = _parts(file.read_text(encoding="utf-8")) if file.is_file() else {}
    parts |= _parts(text)
    file.write_text("\n\n".join(parts.values()) + "\n", encoding="utf-8")
    (out / f"{stem or page}.json").write_text(json.dumps(document) + "\n", encoding="utf-8")
    print(text)


def _parts(text: str) -> dict[str, str]:
    """The parts of a page by their titles, in order."""
    return {part.partition("\n")[0]: part.strip() for part in re.split(r"^(?=# )", text, flags=re.MULTILINE) if part}


def command(name: str) -> str:
    """How to make the table again."""
    given = iter(sys.argv[1:])
    options = [argument for argument in given if not (argument == "--out" and next(given))]
    (script,) = (ROOT / "bench").glob(f"*/{name}.py")
    module = f"bench.{script.parent.name}.{name}"
    return shlex.join(["python", "-m", module, *options]) if options else f"make bench-{name.replace('_', '-')}"


def machine() -> dict[str, Any]:
    """What the figures depend on, with the load average that says whether the machine was quiet."""
    packages = {name: version(name) for name in ("mitsuba", "drjit")}
    load = round(os.getloadavg()[0], 1)
    return {"cores": os.cpu_count(), "architecture": platform.machine(), "load_average": load, **packages}


def commit() -> str:
    """The commit of this checkout, abbreviated, and whether more is changed than results; 'unknown' without git.

    The results' own folder does not count: a benchmark writes there while it runs.
    """
    try:
        head = _git("rev-parse", "--short", "HEAD")
        changed = _git("status", "--porcelain", "--", ".", ":(exclude)docs/results")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head + (" with uncommitted changes" if changed else "")


def _git(*arguments: str) -> str:
    """What git says about this checkout."""
    root = FOLDER.parents[1]
    return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True).stdout.strip()


def footer(name: str) -> str:
    """Command, commit and machine, as the last line of a page."""
    made_on = ", ".join(f"{key} {value}" for key, value in machine().items())
    return f"Made by `{command(name)}` at commit {commit()} ({made_on})."


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table."""
    return format_markdown_table(header, [[*map(str, row)] for row in rows])
