import importlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import pytest

from photonfarm.cli.main import umbrella

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def photonfarm_in() -> Callable[[Path], Command]:
    """The command line, run in a folder and away from any Redis of the machine."""

    def command(folder: Path) -> Command:
        def run(*args: str | Path, timeout: float = 300, **environment: str) -> subprocess.CompletedProcess[str]:
            return subprocess.run(
                [sys.executable, "-m", "photonfarm.cli", *map(str, args)],
                cwd=folder,
                capture_output=True,
                text=True,
                timeout=timeout,
                check=False,
                env={**os.environ, "PHOTONFARM_REDIS_URL": "redis://127.0.0.1:1/0", **environment},
            )

        return run

    return command


@pytest.fixture
def photonfarm(photonfarm_in: Callable[[Path], Command], tmp_path: Path) -> Command:
    """The command line in an empty folder."""
    return photonfarm_in(tmp_path)


@pytest.fixture(scope="session")
def small_room_in() -> Callable[[Path], Path]:
    """Writes the ready spec `room`, at 16² and with a small cloud: its kernels, at a fraction of its time."""
    import photonfarm.scene

    text = (Path(photonfarm.scene.__file__).parent / "specs/room.toml").read_text()
    text = re.sub(r"(?m)^(width|height) = .*$", r"\1 = 16", re.sub(r"(?m)^points = .*$", "points = 512", text))

    def write(folder: Path) -> Path:
        (folder / "small.toml").write_text(text)
        return folder / "small.toml"

    return write


@pytest.fixture
def small_room(small_room_in: Callable[[Path], Path], tmp_path: Path) -> Path:
    """The spec of the small room, in an empty folder."""
    return small_room_in(tmp_path)


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], None]:
    """The command line, which does nothing but parse, and asks for no file. Raises UsageError."""
    monkeypatch.setenv("PHOTONFARM_DEVICE", "cpu")  # `--device` sets it, and the test's end restores it
    monkeypatch.setattr(click.Command, "invoke", lambda *_: None)
    monkeypatch.setattr(click.Path, "convert", lambda _, value, *__: value)
    return lambda arguments: umbrella.main(arguments, prog_name="photonfarm", standalone_mode=False)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: an empty one, without a Redis, and with modules of its own."""
    monkeypatch.setenv("PHOTONFARM_REDIS_URL", "redis://127.0.0.1:1/0")
    monkeypatch.delenv("PHOTONFARM_SCENES", raising=False)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    sys.modules.pop("mine", None)
    importlib.invalidate_caches()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"
