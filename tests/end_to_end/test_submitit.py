"""The example for submitit, where there is no SLURM: its executor of local processes runs it."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from photonfarm.store import Store

ROOT = Path(__file__).parents[2]

pytest.importorskip("submitit", reason="submitit is not installed")


@pytest.mark.slow
def test_the_example_for_submitit_runs_in_local_processes(tmp_path: Path, photonfarm: Any, small_room: Path) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/slurm.md").read_text(), re.DOTALL)
    here = example.replace('(folder="slurm")', '(folder="slurm", cluster="local")').replace("range(4)", "range(2)")
    assert here.count("local") == 1
    request = ("--modifications", "8", "--views", "1", "--shard-rows", "2")
    planned = photonfarm("submit", small_room, *request, "--no-queue")
    assert planned.returncode == 0, planned.stderr
    script = here + "\nassert [job.result() for job in jobs] == [None, None]\n"
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (scene,) = Store(tmp_path / "store").scenes()
    assert scene.missing_jobs() == []
    assert len(scene.committed_jobs()) == 4
