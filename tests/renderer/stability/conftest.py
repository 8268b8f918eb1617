"""What these tests share: the variant, and one thread, with which equal seeds give equal images."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from photonfarm.renderer import backend

backend.load(threads=1)
import drjit as dr  # noqa: E402 - after the variant is set


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> Iterator[None]:
    before = dr.thread_count()
    dr.set_thread_count(1)
    yield
    dr.set_thread_count(before)
