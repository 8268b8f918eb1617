#!/usr/bin/env python3
"""Mitsuba's `path` on the views that have references: its error and the time of an image, at several samples per pixel.

    python experiments/path_tracing.py --store STORE --scene ID --references FOLDER --hold-out SHARE --out FILE

Leaves JSON with a row for each number of samples, as tables read it. It renders on one core.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script this finds its own folder alone

from photonfarm.core.archives import Seconds
from photonfarm.core.files import write_whole
from photonfarm.core.keys import seed_of
from photonfarm.core.statistics import Estimate
from photonfarm.renderer.jobs.render import load_scene
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.spec_loading import locate
from photonfarm.store import SceneReader
from photonfarm.trainer.compare.evaluation_samples import HeldOutSamples, Reference, read_references
from photonfarm.trainer.metrics.image_metrics import metric_space, mse

SPP = (1, 4, 16, 64, 128)
WARM_UPS = 2
ALL = 1 << 30  # held-out views


def measure_path(
    scene: LoadedScene, reader: SceneReader, references: dict[int, Reference], spp: int, integrator: Any
) -> dict[str, Any]:
    """The row of so many samples per pixel; its errors are of clip(exposure · I, 0, 1)^(1/2.2), view by view."""
    seconds, errors, rows = [], [], list(references)
    for place, row in enumerate([*rows[:1] * WARM_UPS, *rows]):
        modification, view, _ = reader.inputs(row)
        scene.apply(modification)
        seed = seed_of(reader.sample_keys([row])[0], f"path, {spp} spp")
        began = backend.work_s()
        image = scene.render(view, seed, integrator, spp)
        took = backend.work_s() - began
        if place >= WARM_UPS:
            halves = (references[row].half_a, references[row].half_b)
            shown = (metric_space(each[None]) for each in (np.float32(reader.spec.exposure) * image, *halves))
            seconds.append(took)
            errors.append(float(mse(*shown)[0]))
    time_s = Seconds.of(np.array(seconds))
    return {
        "frame_seconds": {"total": time_s.median, "ranges": {"render": [time_s.low, time_s.high]}},
        "mse": asdict(Estimate.of(np.array(errors))),
        "mse_of_images": errors,
    }


def main() -> int:
    """Measure and write; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for option in ("--store", "--scene", "--references", "--hold-out", "--out"):
        parser.add_argument(option, required=True)
    told = parser.parse_args()
    backend.load(threads=1)
    import mitsuba as mi

    reader = SceneReader(told.store, told.scene)
    references = read_references(Path(told.references), HeldOutSamples.of(reader, float(told.hold_out), ALL))
    scene = load_scene(locate(reader.spec))
    integrator = mi.load_dict({"type": "path", "max_depth": reader.spec.transport.max_depth})
    rows = {f"path {spp} spp": measure_path(scene, reader, references, spp, integrator) for spp in SPP}
    write_whole(Path(told.out), json.dumps(rows) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
