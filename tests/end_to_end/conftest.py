import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def photonfarm(tmp_path: Path) -> Command:
    """Runs the command line in an empty folder, away from any Redis of the machine."""

    def run(*args: str | Path, timeout: float = 300, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "photonfarm.shared.cli", *map(str, args)],
            cwd=tmp_path, capture_output=True, text=True, timeout=timeout, check=False,
            env={**os.environ, "PHOTONFARM_REDIS_URL": "redis://127.0.0.1:1/0", **environment},
        )  # fmt: skip

    return run


@pytest.fixture
def small_room(tmp_path: Path) -> Path:
    """The ready spec `room`, at 16² and with a small cloud: its kernels and its code, at a fraction of its time."""
    import photonfarm.shared

    text = (Path(photonfarm.shared.__file__).parent / "specs/room.toml").read_text()
    text = re.sub(r"(?m)^(width|height) = .*$", r"\1 = 16", re.sub(r"(?m)^points = .*$", "points = 512", text))
    (tmp_path / "small.toml").write_text(text)
    return tmp_path / "small.toml"
