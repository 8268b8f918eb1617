"""What the tests of scenes share."""

import gc

import pytest


@pytest.fixture(autouse=True, scope="module")
def no_other_materials() -> None:
    """Kernels hold the code of every material that is alive, also of other tests' that can only be looked at."""
    gc.collect()
