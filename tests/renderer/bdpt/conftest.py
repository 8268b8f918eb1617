"""What the integrator's tests share: the variant, and comparisons that keep the images of a failure."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonfarm.core.statistics import block_z_test
from photonfarm.renderer.scene import backend

mi = backend.load(threads=1)

Z_LIMIT = 4.5  # a normal z beyond this has probability 7e-6; with 16 blocks a test fails by chance once in 10 000 runs
FAILURES = Path(os.environ.get("PHOTONFARM_TEST_FAILURES", "test-failures"))


@pytest.fixture
def renders() -> Callable[..., Any]:
    """Function (scene, integrator dictionary, spp, seeds) → images [K, H, W, 3]."""

    def render(scene: Any, integrator: dict[str, Any], spp: int, seeds: range) -> Any:
        plugin = mi.load_dict(integrator)
        return np.stack([np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed))[..., :3] for seed in seeds])

    return render


@pytest.fixture
def assert_equal_means(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Function that fails unless two sets of images have equal means in every block.

    It keeps the images of a failure.
    """

    def check(a: Any, b: Any, blocks: int = 4) -> None:
        test = block_z_test(a, b, blocks=blocks)
        if test.finite and test.z_max < Z_LIMIT:
            return
        folder = save(request, bdpt=a, reference=b)
        pytest.fail(
            f"largest block |z| {test.z_max:.2f} (limit {Z_LIMIT}), means' ratio {test.mean_ratio:.4f} ± "
            f"{test.mean_ratio_standard_error:.4f}, finite: {test.finite}\n{np.round(test.z, 1)}\n"
            f"images: {folder}\nrepeat: python -m pytest '{request.node.nodeid}'"
        )

    return check


def save(request: pytest.FixtureRequest, **images: Any) -> Path:
    folder = FAILURES / request.node.name
    folder.mkdir(parents=True, exist_ok=True)
    for name, stack in images.items():
        np.save(folder / f"{name}.npy", stack)
        mean = mi.Bitmap(np.ascontiguousarray(np.mean(stack, axis=0), dtype=np.float32))
        # Not EXR: Mitsuba's writer waits forever when Dr.Jit has a single thread
        mean.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True).write(
            str(folder / f"{name}.png")
        )
    return folder.resolve()
