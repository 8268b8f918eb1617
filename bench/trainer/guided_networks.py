"""What each part of the guided networks is worth, at equal processor time, room by room.

Every candidate is trained by the recipe of the preset `small` for as many steps as fit the same seconds: what a step
costs is timed before. Errors are in the metric space against references, the references' noise taken out;
intervals are over held-out configurations, the seeds' mean of each.

    PHOTONFARM_SCENES=… python -m bench.trainer.guided_networks --rooms room night-living-room-2 movable-veach-ajar

A room is a built-in spec, or an experiment of experiments/ in its small size, whose store it shares.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bench.harness import results, room_study
from bench.harness.scenes import in_passes, square
from photonfarm.shared.core.estimate import Estimate, group_means
from photonfarm.shared.plan.request import Request
from photonfarm.shared.plan.top_up import TopUp
from photonfarm.shared.scene.spec import SceneSpec
from photonfarm.shared.store import Store
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.data.store_source import StoreSource
from photonfarm.trainer.metrics import confidence_interval, mssim
from photonfarm.trainer.metrics.metric_space import metric_space
from photonfarm.trainer.predict.evaluation import by_turns
from photonfarm.trainer.runs.settings import TrainSettings, preset
from photonfarm.trainer.training.learner import Learner

CANDIDATES: dict[str, dict[str, Any]] = {
    "cnn": {"architecture": "cnn"},
    "light_transport": {"architecture": "light_transport"},
    "light_transport_photons": {"architecture": "light_transport_photons"},
    "guided": {"architecture": "guided"},
    "guided_transport": {"architecture": "guided_transport"},
    "guided_photons": {"architecture": "guided_photons"},
    "guided_transport_photons": {"architecture": "guided_transport_photons"},
}
WITHOUT = {
    "guided": ("cnn",),
    "guided_transport": ("guided",),
    "guided_photons": ("guided",),
    "guided_transport_photons": ("guided_photons", "guided_transport"),
}
"""What each is compared with: itself without a part."""

HOLD_OUT = 1 / 8
TIMED_STEPS = 12


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """A candidate in a room."""

    name: str
    step_s: float
    steps: int
    frame_s: float
    errors: NDArray[np.float64]  # (seeds, views) in the metric space
    mssim: float


def main() -> None:
    """Render, train and measure; write the page."""
    parser = results.parser(__doc__)
    parser.add_argument("--rooms", nargs="+", default=["room"], help="specs (%(default)s)")
    parser.add_argument("--candidates", nargs="+", choices=CANDIDATES, default=list(CANDIDATES))
    parser.add_argument("--modifications", type=int, default=512)
    parser.add_argument("--references", type=int, default=48, help="held-out views (%(default)s)")
    parser.add_argument("--reference-spp", type=int, default=256)
    parser.add_argument("--seconds", type=float, default=60.0, help="of processor time, for each run (%(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--work", type=Path, default=results.ROOT / "build/experiments/small")
    told = parser.parse_args()
    found = {name: measured(name, told) for name in told.rooms}
    text = page(found, told)
    figures = {room: [_document(result) for result in each] for room, each in found.items()}
    results.write("guided_networks", text, {"seconds": told.seconds, "rooms": figures}, told.out)


def small(name: str) -> SceneSpec:
    """The room at 64², 8 samples per pixel."""
    return in_passes(square(room_study.named_room(name), 64), 4)


def measured(name: str, told: argparse.Namespace) -> list[Result]:
    """All candidates in one room."""
    spec = small(name)
    store = Store(told.work / name / "store", create=True)
    passes = TopUp.of(str(told.reference_spp), [f"held-out={HOLD_OUT}", f"views=first:{told.references}"])
    room_study.render(spec, store, [Request(modifications=told.modifications), passes], told.processes)
    steps = step_seconds(store, spec, told.candidates)
    runs = {
        (candidate, seed): room_study.Run(
            functools.partial(StoreSource, store.root, spec.scene_id),
            settings_of(candidate, seed, max(1, round(told.seconds / steps[candidate]))),
            told.work / name / "guided_networks",
            candidate,
        )
        for candidate in told.candidates
        for seed in told.seeds
    }
    room_study.train_all(list(runs.values()), told.processes)
    references = room_study.ReferenceViews.of(store, spec, told.reference_spp, HOLD_OUT)
    source = functools.partial(StoreSource, store.root, spec.scene_id)
    frames = frame_seconds({name: runs[name, told.seeds[0]] for name in told.candidates}, source, references.rows)
    found = []
    for candidate in told.candidates:
        made = [room_study.images(runs[candidate, seed].trained(), source(), references.rows) for seed in told.seeds]
        of_view = [mssim(metric_space(image), metric_space(references.mean)) for image in made]
        found.append(
            Result(
                candidate, steps[candidate], runs[candidate, told.seeds[0]].settings.max_steps, frames[candidate],
                np.stack([_by_configuration(references.shown_errors(image), references) for image in made]),
                float(np.mean(of_view)),
            )
        )  # fmt: skip
    return found


def settings_of(candidate: str, seed: int, steps: int) -> TrainSettings:
    """The preset `small` with the candidate's network."""
    return preset(
        "small", network=CANDIDATES[candidate], seed=seed, max_steps=steps, hold_out=HOLD_OUT,
        validate_every=max(1, steps // 4), validation_samples=24,
    )  # fmt: skip


def step_seconds(store: Store, spec: SceneSpec, candidates: Sequence[str]) -> dict[str, float]:
    """Processor seconds of a step of each on one thread, the median of some, on samples that are there."""
    torch.set_num_threads(1)  # more would turn while they wait, and be counted
    times: dict[str, list[float]] = {name: [] for name in candidates}
    for name in candidates:
        settings = settings_of(name, 0, 1000)
        with Feed(StoreSource(store.root, spec.scene_id), settings) as feed:
            rows = [row for row, held in feed.arrivals()[0] if not held][: 2 * settings.batch]
            learner = Learner(feed, settings)
            for number in range(TIMED_STEPS):
                feed.ask(rows[: settings.batch])
                batch = feed.take()
                times[name].append(_timed(functools.partial(learner.step, number, batch)))
    return {name: float(np.median(found[2:])) for name, found in times.items()}


def _timed(work: Callable[[], Any]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def frame_seconds(
    runs: dict[str, room_study.Run], source: Callable[[], StoreSource], rows: Sequence[int]
) -> dict[str, float]:
    """Wall seconds of one image of each network, by turns."""
    calls = []
    for run in runs.values():
        trained = run.trained()
        with Feed(source(), trained.settings, needs=trained.needs) as feed:
            predict = trained.predictor(feed.spec, (feed.geometry, feed.cloud), "cpu")
            feed.ask(rows[:1])
            calls.append((predict, predict.of_its_own(feed.take().inputs)))
    return {name: seconds.median for name, seconds in zip(runs, by_turns(calls), strict=True)}


def _by_configuration(errors: NDArray[np.float64], references: room_study.ReferenceViews) -> NDArray[np.float64]:
    return np.array(group_means(errors, references.units))


def page(found: dict[str, list[Result]], told: argparse.Namespace) -> str:
    """The tables as Markdown."""
    header = ("network", "MSE", "MSSIM", "ms a step", "steps", "ms a frame", "without")
    parts = [
        f"""# What the parts of guided networks are worth

{told.modifications} samples of 64², 8 samples per pixel, {told.references} held-out references of
{told.reference_spp}; {told.seconds:g} s of one core for each run, seeds {", ".join(map(str, told.seeds))}. MSE and
MSSIM in the metric space. “Without” is how far above its MSE the same network without a part is, with the 95 % interval
over held-out configurations, and by each seed."""
    ]
    for room, each in found.items():
        by_name = {result.name: result for result in each}
        parts += [f"## {room}", results.table(header, [_line(result, by_name) for result in each])]
    return "\n\n".join(parts)


def _line(result: Result, by_name: dict[str, Result]) -> list[Any]:
    less = [by_name[name] for name in WITHOUT.get(result.name, ()) if name in by_name]
    return [
        result.name, f"{result.errors.mean():.5f}", f"{result.mssim:.3f}", f"{1e3 * result.step_s:.0f}", result.steps,
        f"{1e3 * result.frame_s:.0f}", "; ".join(_gap(result, without) for without in less) or "–",
    ]  # fmt: skip


def _gap(result: Result, without: Result) -> str:
    """How much worse it is without the part, and with each seed."""
    differences, base = without.errors - result.errors, result.errors.mean()
    pairs = Estimate.of(differences.mean(0))
    low, high = confidence_interval(pairs) or (np.nan, np.nan)
    seeds = ", ".join(f"{difference / base:+.0%}" for difference in differences.mean(1))
    return f"{without.name} {pairs.mean / base:+.0%} ({low / base:+.0%} … {high / base:+.0%}; {seeds})"


def _document(result: Result) -> dict[str, Any]:
    return {
        "name": result.name, "step_s": result.step_s, "steps": result.steps, "frame_s": result.frame_s,
        "mssim": result.mssim, "errors": result.errors.tolist(),
    }  # fmt: skip


if __name__ == "__main__":
    main()
