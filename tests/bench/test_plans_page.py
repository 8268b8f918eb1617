"""The page about a plan of a million samples."""

from __future__ import annotations

from argparse import Namespace

import pytest

import plans
from photonfarm.shared.queue import QUEUE_LIMIT


@pytest.mark.parametrize(("queued", "said"), [(QUEUE_LIMIT, ", which is the limit, "), (312, " jobs queued, Redis ")])
def test_the_page_says_that_the_queue_is_at_its_limit_only_where_it_is(queued: int, said: str) -> None:
    sizes = {"queued_jobs": queued, "redis_bytes": 2, "redis_empty_bytes": 1, "plan_bytes": 1}
    page = plans.page([], sizes, Namespace(samples=10_000, views=1, spec="room"))
    assert said in page
    assert ("the limit" in page) is (queued == QUEUE_LIMIT)
