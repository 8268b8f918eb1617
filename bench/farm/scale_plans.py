"""What a scene's number of plans costs, as of many submissions: the same samples in ever more plans."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from bench.farm.scale_store import FURTHER, SHARD_ROWS, SPEC, Costs, timed

SAMPLES = 100_000


def main() -> int:
    """Measure one number of plans, given as JSON; the costs go to stdout as JSON."""
    given = json.loads(sys.argv[1])
    print(json.dumps(costs(Path(given["folder"]), given["plans"])))
    return 0


def costs(folder: Path, count: int) -> Costs:
    """A worker's start, keys of all samples, and a further submission, with so many plans."""
    from photonfarm.plan.request import Request
    from photonfarm.scene.modification import modification_keys
    from photonfarm.scene.spec_loading import NamedSpec
    from photonfarm.store import SceneReader, Store
    from photonfarm.store.model import plans

    spec = NamedSpec.load(SPEC).spec
    store = Store(folder / "store", create=True)
    for number in range(count):
        store.plan(spec, Request(modifications=SAMPLES // count, seed=number + 1), shard_rows=SHARD_ROWS)

    def start() -> object:
        scene = Store(folder / "store").scene(spec.scene_id)
        return scene, scene.jobs(), scene.is_committed(0), scene.job_rows(0)

    def keys() -> object:
        import numpy as np

        found = store.scene(spec.scene_id).plans()
        rows = np.concatenate([plan.rows.sample_modification for plan in found])
        return modification_keys(spec.radiance_id, plans.vectors_at(found, "modification", rows[rows >= 0]))

    opened, of_keys = timed(start), timed(keys)
    more = timed(lambda: store.plan(spec, Request(modifications=FURTHER), dry_run=True))
    reader = SceneReader(folder / "store", spec.scene_id)
    look = timed(reader.refresh)
    return {
        "open_core_s": opened["core_s"], "open_read": opened["read"], "keys_core_s": of_keys["core_s"],
        "more_core_s": more["core_s"], "look_core_s": look["core_s"],
    }  # fmt: skip


def measured(folder: Path, count: int) -> Costs:
    """The costs of so many plans, in a process of its own."""
    given = json.dumps({"folder": str(folder), "plans": count})
    command = [sys.executable, "-m", "bench.farm.scale_plans", given]
    found: Costs = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    return found


if __name__ == "__main__":
    sys.exit(main())
