"""A worker's child that takes over finds the kernels that the one before has compiled."""

from pathlib import Path

import pytest

from photonfarm.plan.request import Request
from photonfarm.renderer.worker.worker import run_worker
from photonfarm.scene.spec import Film
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import Store
from photonfarm.store.format.markers import marker_name


@pytest.mark.slow
def test_a_child_that_takes_over_compiles_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each renders one job, of another configuration, in a process of its own."""
    kernels = tmp_path / "kernels"
    monkeypatch.setenv("DRJIT_CACHE_DIR", str(kernels))
    monkeypatch.setenv("PHOTONFARM_DEVICE", "cpu")
    store = Store(tmp_path / "store", create=True)
    spec = load_spec("cornell").model_copy(update={"film": Film(width=16, height=16)})
    scene = store.scene(store.plan(spec, Request(modifications=2), shard_rows=1).scene_id)
    run_worker(store.root, share="0/1", until_complete=True, max_jobs=1, reserve_bytes=0, quiet=True)
    markers = [tmp_path / "store" / marker_name(scene.name, job) for job in range(2)]
    first = min(marker.stat().st_mtime_ns for marker in markers)
    compiled = [file.stat().st_mtime_ns for file in kernels.glob("*.bin")]
    assert len(compiled) > 10
    assert max(compiled) < first
    core_s = sorted(scene.marker(job)["figures"]["core_s"] for job in range(2))
    assert core_s[0] < core_s[1] / 2, "kernels are loaded in a fraction of the time that compiling takes"
