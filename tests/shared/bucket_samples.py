"""Small stores in a bucket or a folder, and what the tests of object storage do with them."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import store_samples as samples

from photonfarm.plan.request import Request
from photonfarm.store import SceneStore, Store
from photonfarm.store.io.objects import ObjectStorage


def planned(place: str | Path, **request: int) -> SceneStore:
    """A scene with jobs of 2 samples."""
    store = Store(place, create=True)
    return store.scene(store.plan(samples.small_spec(), Request(**request), shard_rows=2).scene_id)


def at_once(*actions: Callable[[], Any]) -> list[Any]:
    """What the actions return, begun together, each in a thread of its own."""
    barrier, results = threading.Barrier(len(actions)), [None] * len(actions)

    def act(i: int) -> None:
        barrier.wait()
        results[i] = actions[i]()

    threads = [threading.Thread(target=act, args=(i,)) for i in range(len(actions))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return results


def put(storage: ObjectStorage, content: bytes, name: str, **how: Any) -> bool:
    """Place an object of this content, by way of a file, and return whether it was placed."""
    part = storage.part()
    part.write_bytes(content)
    return storage.adopt(part, name, **how)
