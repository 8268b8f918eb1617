"""Errors of our networks at equal time: each trained here, for a part of the minutes, on images of other views.

A frame of a network is all that `predict` does for a view of a configuration: inputs, the noisy half where it is given
one, the network, and its image in numpy's memory. Beside it is what Open Image Denoise makes of that time.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.card.equal_time import PLAIN, REPETITIONS, RenderedRoom, load_oidn, timed_s
from bench.card.rates import MAX_DEPTH
from bench.card.rooms import draw_view, make_once, on_card
from bench.harness import results
from bench.harness.scenes import ready_spec, square
from photonfarm.core.statistics import clean_error
from photonfarm.plan.request import Request
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneReader, Store

TITLE = "Equal time, networks"
NETWORKS = ("guided_denoise", "guided_transport", "denoise_1")
HALF_SPP = 8
RENDERED, TRAINED = 1 / 8, 1 / 4
"""Shares of a part's time in which images are rendered, once for all networks of a room, and a network is trained."""

PROBED = 100  # steps, which say how many fit: with the last of them the learning rate is to be 0

CONFIGURATIONS, VIEWS, LEAST_JOBS = 8, 2, 4  # of a job; and jobs, so that some configurations are held out


def measure(name: str, size: int, out: Path, limit_s: float) -> dict[str, Any]:
    """The error and the time of a network's frame, and the least error of Open Image Denoise in that time.

    Raises SpecError where that is not installed, or the room's file is missing.
    """
    room, _, architecture = name.rpartition("-")
    denoisers, spec = load_oidn(), training_spec(room, size)
    stored = out / f"store-{spec.scene_id}"
    make_once(stored, partial(render_images, spec, RENDERED * limit_s))
    with tempfile.TemporaryDirectory(dir=out) as run:
        trained = train_for(TRAINED * limit_s, stored, spec.scene_id, architecture, Path(run))
        rendered = RenderedRoom(room, size, out)
        frame_s, error = measure_frames(rendered, Path(run), stored)
    ms = 1e3 * frame_s
    rows = {label: rendered.errors(PLAIN, denoise, guide, [ms])["frames"] for label, denoise, guide in denoisers}
    best = min(
        ((frame["mse"], frame["spp"], label) for label, row in rows.items() for frame in row.values()), default=None
    )
    return {"size": size, **trained, "ms": ms, "mse": error, "oidn": best}


def training_spec(room: str, size: int) -> SceneSpec:
    """The room as it is rendered for networks: as far as the references go, and not further."""
    spec = square(ready_spec(room), size)
    transport = spec.transport.model_copy(update={"max_depth": MAX_DEPTH, "half_spp": HALF_SPP})
    return spec.model_copy(update={"transport": transport})


def render_images(spec: SceneSpec, seconds: float, root: Path) -> None:
    """Fill a store for so long after its first job, which compiles. Seeds are not that of the views with references."""
    from photonfarm.renderer.jobs.render import ShardRenderer

    store = Store(root, create=True)
    scene, renderer = store.add(spec), ShardRenderer(store, worker="bench")
    jobs, until = 0, math.inf
    while jobs < LEAST_JOBS or time.monotonic() < until:
        request = Request(modifications=CONFIGURATIONS, views_per_modification=VIEWS, seed=1 + jobs)
        scene.plan(request, shard_rows=CONFIGURATIONS * VIEWS)
        renderer.render(spec.scene_id, jobs)
        jobs += 1
        if jobs == 1:
            until = time.monotonic() + seconds


def train_for(seconds: float, stored: Path, scene_id: str, architecture: str, run: Path) -> dict[str, Any]:
    """Train a network by the preset for this device, in as many steps as fit; how long that took, and on how much."""
    from photonfarm.trainer.runs.run_folder import METRICS, read_log
    from photonfarm.trainer.runs.settings import make_preset
    from photonfarm.trainer.training.loop import train

    preset, device = ("card", "cuda") if on_card() else ("small", "cpu")
    changes = {"validate_every": 1000, "validation_samples": 8, "max_steps": PROBED, "max_seconds": seconds}
    settings = make_preset(preset, network={"architecture": architecture}, device=device, **changes)
    steps = train(SceneReader(stored, scene_id), settings, run).step
    took = read_log(run / METRICS)[-1]["seconds"]
    left_s, step_s = seconds - sum(took.values()), (sum(took.values()) - took["start"]) / max(steps, 1)
    fitting = {"max_steps": max(steps, 1) + max(0, int(left_s / step_s)), "max_seconds": None}
    train(SceneReader(stored, scene_id), settings.model_copy(update=fitting), run)
    end = read_log(run / METRICS)[-1]
    trained_s = sum(end["seconds"].values())
    return {"preset": preset, "trained_s": trained_s, "steps": end["step"], "images": end["samples"]}


def measure_frames(rendered: RenderedRoom, run: Path, stored: Path) -> tuple[float, float]:
    """Seconds of a frame of a trained network, and its error, of the views with references."""
    from photonfarm.predict import open_run

    opened, modification = open_run(run, stored), draw_view(rendered.scene, 0)[0]

    def predict(number: int) -> Any:
        return opened.predict(modification, rendered.views[number]).radiance.detach().cpu().numpy()

    for number in (0, 0):  # compiles, and may record once more
        predict(number)
    numbers = range(len(rendered.views))
    timed = [timed_s(partial(predict, number)) for _ in range(REPETITIONS) for number in numbers]
    images = zip((image for _, image in timed), rendered.references, strict=False)
    errors = [clean_error(rendered.display(np.asarray(image)), *halves) for image, halves in images]
    return statistics.median(s for s, _ in timed), statistics.fmean(errors)


def describe(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The table."""
    header = ("", "trained, s", "steps", "images", "a frame, ms", "MSE", "MSE of OIDN in that", "namely (spp)")
    rows = []
    for name, of in found.items():
        mse, spp, label = of["oidn"] or (math.nan, 0, "none fits")
        trained = f"{of['trained_s']:.0f}", of["steps"], of["images"]
        errors = f"{of['mse']:.5f}", f"{mse:.5f}", f"{label} ({spp})"
        rows.append([f"{name} {of['size']}²", *trained, f"{of['ms']:.1f}", *errors])
    preset = next(iter(found.values()))["preset"]
    about = (__doc__ or "").split("\n\n", 1)[1].strip()
    return f"""{about}
Networks were trained by the preset `{preset}` on configurations and views of other seeds, with {HALF_SPP} spp a half,
which is also what `guided_denoise` and `denoise_1` are given here. Errors are as above, of the same views. The scene
stands still: what a new configuration takes is charged to neither.

{results.table(header, rows)}"""
