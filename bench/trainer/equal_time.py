"""Changes to the preset `small`, each trained for the same processor time, in one room after another.

What a step costs is timed before, and as many are taken as fit. Errors are in the metric space against references, the
references' noise taken out.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench.harness import results, room_study
from bench.harness.network_errors import Errors, of_intervals
from bench.harness.scenes import in_passes, square
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.metrics import mssim
from photonfarm.trainer.metrics.image_metrics import metric_space
from photonfarm.trainer.predict.evaluation import time_by_turns
from photonfarm.trainer.runs import settings
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.learner import Learner

PresetChanges = Mapping[str, Any]
"""Changes to the preset, by key."""

HOLD_OUT = 1 / 8
ROUNDS, STEPS = 6, 3

COLUMNS = ("MSE", "MSSIM", "ms a step", "steps", "ms a frame")
"""The headings of `Result.cells`."""


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """A candidate in a room."""

    name: str
    step_s: float
    steps: int
    frame_s: float
    errors: Errors  # in the metric space
    mssim: float

    @property
    def mse(self) -> float:
        """The mean over configurations and seeds."""
        return self.errors.estimate().mean

    def cells(self) -> list[Any]:
        """What a table says of it."""
        times = f"{1e3 * self.step_s:.0f}", self.steps, f"{1e3 * self.frame_s:.0f}"
        return [f"{self.mse:.5f}", f"{self.mssim:.3f}", *times]

    def document(self) -> dict[str, Any]:
        """What a page's JSON holds of it."""
        return {
            "name": self.name, "step_s": self.step_s, "steps": self.steps, "frame_s": self.frame_s,
            "mssim": self.mssim, "errors": self.errors.values.tolist(),
            "units": [unit.hex() for unit in self.errors.units],
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class Gap:
    """How far the MSE of one candidate is above that of another, as shares of the other's."""

    share: float
    low: float
    high: float
    seeds: tuple[float, ...]

    @classmethod
    def of(cls, one: Result, other: Result) -> Gap:
        """The gap of `one` above `other`; the interval is `Errors.interval`."""
        more = one.errors.less(other.errors)
        found = np.array([more.estimate().mean, *more.interval(), *more.of_seeds()]) / other.mse
        share, low, high, *seeds = found.tolist()
        return cls(share, low, high, tuple(seeds))

    def __str__(self) -> str:
        seeds = ", ".join(f"{seed:+.0%}" for seed in self.seeds)
        return f"{self.share:+.0%} ({self.low:+.0%} … {self.high:+.0%}; {seeds})"

    def verdict(self) -> str:
        """Whether the interval tells `one` from the other."""
        if self.low > 0:
            return "worse"
        return "better" if self.high < 0 else "not told apart"


def parser(about: str | None, candidates: Mapping[str, PresetChanges]) -> argparse.ArgumentParser:
    """A parser with the options of such a study."""
    made = results.parser(about)
    made.add_argument("--rooms", nargs="+", default=["room"], help="specs (%(default)s)")
    made.add_argument("--candidates", nargs="+", choices=candidates, default=list(candidates), metavar="NAME")
    made.add_argument("--modifications", type=int, default=512)
    made.add_argument("--references", type=int, default=48, help="held-out views (%(default)s)")
    made.add_argument("--reference-spp", type=int, default=256)
    made.add_argument("--seconds", type=float, default=60.0, help="of processor time, for each run (%(default)s)")
    made.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    made.add_argument("--processes", type=int, default=2)
    made.add_argument("--work", type=Path, default=results.ROOT / "build/experiments/small")
    return made


def conditions(options: argparse.Namespace) -> str:
    """What a page says of its figures."""
    seeds = ", ".join(map(str, options.seeds))
    return f"""{options.modifications} samples of 64², 8 samples per pixel, {options.references} held-out references of
{options.reference_spp}; {options.seconds:g} s of one core for each run, seeds {seeds}. MSE and MSSIM in the metric
space. Gaps have their 95 % interval and the gap of each seed in brackets. {of_intervals(len(options.seeds))}"""


def write(name: str, text: str, found: Mapping[str, Sequence[Result]], options: argparse.Namespace) -> None:
    """Save a page and the figures of each room."""
    rooms = {room: [result.document() for result in each] for room, each in found.items()}
    results.write(name, text, {"seconds": options.seconds, "rooms": rooms}, options.out)


# ---------------------------------------------------------------------------------------------------------- measuring


def measured(
    room: str, candidates: Mapping[str, PresetChanges], options: argparse.Namespace, folder: str
) -> list[Result]:
    """Render a room, train all candidates on it in a folder of this name, and measure them."""
    spec = in_passes(square(room_study.named_room(room), 64), 4)
    store = Store(options.work / room / "store", create=True)
    passes = TopUp.of(str(options.reference_spp), [f"held-out={HOLD_OUT}", f"views=first:{options.references}"])
    room_study.render(spec, store, [Request(modifications=options.modifications), passes], options.processes)
    source = functools.partial(SceneReader, store.root, spec.scene_id)
    step_s = step_seconds(source, candidates)
    steps = {name: max(1, round(options.seconds / seconds)) for name, seconds in step_s.items()}
    runs = {
        name: [
            room_study.Run(source, settings_of(changes, seed, steps[name]), options.work / room / folder, name)
            for seed in options.seeds
        ]
        for name, changes in candidates.items()
    }
    room_study.train_all([run for each in runs.values() for run in each], options.processes)
    references = room_study.ReferenceViews.of(store, spec, options.reference_spp, HOLD_OUT)
    frame_s = frame_seconds({name: each[0] for name, each in runs.items()}, references.rows)
    return [
        Result(name, step_s[name], steps[name], frame_s[name], *_errors(each, references))
        for name, each in runs.items()
    ]


def _errors(runs: Sequence[room_study.Run], references: room_study.ReferenceViews) -> tuple[Errors, float]:
    """Squared errors in the metric space, and the mean SSIM."""
    made = [room_study.images(run.trained(), run.source(), references.rows) for run in runs]
    errors = np.stack([references.shown_errors(images) for images in made])
    shown = metric_space(references.mean)
    return Errors(errors, references.units), float(np.mean([mssim(metric_space(images), shown) for images in made]))


def settings_of(changes: PresetChanges, seed: int, steps: int) -> TrainSettings:
    """The preset `small` with these changes."""
    run = {"seed": seed, "max_steps": steps, "hold_out": HOLD_OUT, "validate_every": max(1, steps // 4)}
    return settings.make_settings("small", {**changes, **run, "validation_samples": 24})


def step_seconds(source: Callable[[], SceneReader], candidates: Mapping[str, PresetChanges]) -> dict[str, float]:
    """Processor seconds of a step of each on one thread, the median of some, on samples that are there.

    They take turns, so that the machine's moods reach all alike. The first step of a turn, for which another network
    has left the caches, does not count.
    """
    torch.set_num_threads(1)  # more would turn while they wait, and be counted
    times: dict[str, list[float]] = {name: [] for name in candidates}
    with ExitStack() as stack:
        made = {name: stack.enter_context(_stepping(source(), changes)) for name, changes in candidates.items()}
        for _ in range(ROUNDS):
            for name, step in made.items():
                times[name] += [step() for _ in range(1 + STEPS)][1:]
    return {name: float(np.median(found[STEPS:])) for name, found in times.items()}


@contextmanager
def _stepping(source: SceneReader, changes: PresetChanges) -> Iterator[Callable[[], float]]:
    """What takes a step and returns its processor seconds."""
    chosen = settings_of(changes, 0, 1000)
    with Feed(source, chosen) as feed:
        rows = [row for row, held in feed.arrivals()[0] if not held][: chosen.batch]
        learner, numbers = Learner(feed, chosen), itertools.count()

        def step() -> float:
            feed.ask(rows)
            batch = feed.take()
            began = time.process_time()
            learner.step(next(numbers), batch)
            return time.process_time() - began

        yield step


def frame_seconds(runs: Mapping[str, room_study.Run], rows: Sequence[int]) -> dict[str, float]:
    """Wall seconds of one image of each network, by turns."""
    calls = []
    for run in runs.values():
        trained = run.trained()
        with Feed(run.source(), trained.settings, needs=trained.needs) as feed:
            predict = trained.predictor(feed.spec, (feed.geometry, feed.cloud), "cpu")
            feed.ask(rows[:1])
            calls.append((predict, predict.of_its_own(feed.take().inputs)))
    return {name: seconds.median for name, seconds in zip(runs, time_by_turns(calls), strict=True)}
