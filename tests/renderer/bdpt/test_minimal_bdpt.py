"""The integrator of the documentation, docs/minimal_bdpt.py, has the same mean image as `bdpt`."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import mitsuba as mi
import numpy as np
import pytest

from photonfarm.core.statistics import block_z_test

FILE = Path(__file__).parents[3] / "docs/minimal_bdpt.py"


@pytest.fixture(scope="module")
def minimal() -> ModuleType:
    spec = importlib.util.spec_from_file_location("minimal_bdpt", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look for their module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("max_depth", [1, 2, 4])
def test_the_mean_image_is_that_of_bdpt(minimal: ModuleType, max_depth: int) -> None:
    described = mi.cornell_box()
    described["sensor"]["film"].update(width=16, height=16, rfilter={"type": "box"})
    scene = mi.load_dict(described)
    integrator = mi.load_dict({"type": "bdpt", "max_depth": max_depth, "connections": 1, "light_ratio": 1.0})
    short = np.stack([np.array(minimal.render(scene, max_depth, 64, seed)) for seed in range(16)])
    full = np.stack([np.array(mi.render(scene, integrator=integrator, seed=seed, spp=64)) for seed in range(100, 116)])
    found = block_z_test(short, full, blocks=4)
    assert found.passed, found
    assert abs(found.mean_ratio - 1) < 4 * found.mean_ratio_standard_error < 0.1
    assert full.mean() > 0.05


def test_it_stays_short() -> None:
    assert len(FILE.read_text().splitlines()) <= 150
