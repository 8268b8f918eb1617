"""Command lines that are refused: what they say, and how they end."""

import contextlib
import io
import shlex
import time
from pathlib import Path

import pytest

from photonfarm.cli.main import main

MOST_S = 20.0
"""The longest that any of them may take to be told, on a busy machine."""


def said(command: str) -> tuple[int, str, str]:
    """What a command line ends with, and says on stdout and on stderr; anything but an exit is raised."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), pytest.raises(SystemExit) as ended:
        main(shlex.split(command))
    code = ended.value.code
    assert code is None or isinstance(code, int)
    print(f"$ photonfarm {command}\n{err.getvalue()}{out.getvalue()}[exit code {code or 0}]\n")
    return code or 0, out.getvalue(), err.getvalue()


def refused(command: str, code: int, *names: str, keeps: dict[str, bytes] | None = None) -> None:
    """Assert that a command is refused with this code, in a sentence that names all of it, soon, and takes nothing."""
    began = time.monotonic()
    found, _, err = said(command)
    assert found == code
    assert time.monotonic() - began < MOST_S
    for name in names:
        assert name in " ".join(err.replace("│", " ").split())
    assert "Traceback" not in err
    if code not in (0, 2):  # else click's own sentence, with the usage above
        assert err.splitlines()[-1].startswith("photonfarm: ")
    for file, before in (keeps or {}).items():
        assert Path(file).read_bytes() == before
