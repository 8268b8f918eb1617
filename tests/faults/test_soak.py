"""A short soak; the long one of the same kind is `make bench-soak`."""

import importlib.util
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("soak", Path(__file__).with_name("soak.py"))
soak = importlib.util.module_from_spec(_spec)

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds the workers' children through /proc")


@pytest.mark.timeout(300)
def test_a_farm_under_random_faults_commits_every_job_once_and_bit_for_bit(tmp_path: Path) -> None:
    _spec.loader.exec_module(soak)
    wanted = soak.Toll(kills=8, stops=4, redis_kills=2, flushes=1, submitters=1)
    found = soak.Soak(tmp_path, jobs=60, workers=3, pause_s=0.02, seed=1).run(
        wanted, pace_s=(0.3, 0.9), long_outage_s=4.0
    )
    assert not found.toll.left(wanted)
    assert found.samples == 2 * found.jobs
    assert found.reads > found.samples
