"""Which sampling is best for training and for images, by the same images, and what one loses by the other's choice.

    python -m bench.renderer.plan_purposes [--spec room cornell …] [--seconds 90] [--pairs 8] [--out DIR]

Each spec is measured as `scene plan --for training` does. Then all of its settings render the same number of images,
of the same views and seeds, and these are weighed in both ways. Times are those of the first measurement.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from bench.harness import results
from bench.harness.scenes import ready_spec

SPECS = ("room", "cornell", "living-room-2", "veach-ajar", "dining-room-night")
SECONDS = 90.0
PAIRS = 8
"""Pairs of images of each setting in each view."""
SEED = 40_000_000
"""Far from the seeds of the measurement."""


@dataclass(frozen=True, slots=True)
class Compared:
    """All settings compared for one purpose."""

    plan: Any
    best: Any  # the one with the least error × time that fits the cost

    def over(self, other: Any) -> str:
        """How much longer another takes to the same error than the best, in words."""
        from photonfarm.renderer.strategy.candidates import saving
        from photonfarm.renderer.strategy.printed import plus_minus

        found = saving(self.plan.at_equal_cost[self.best], over=self.plan.at_equal_cost[other])
        return "1" if other == self.best else plus_minus(found.factor, found.spread)


def kept(render: Callable[..., Any]) -> Callable[..., Any]:
    """The same renderer, which renders nothing twice."""
    images: dict[Any, Any] = {}

    def again(*what: Any) -> Any:
        if what not in images:
            images[what] = render(*what)
        return images[what]

    return again


def compare(spec: Any, seconds: float, pairs: int) -> tuple[Compared, Compared]:
    """The settings of a spec for training, and for images."""
    from photonfarm.renderer.strategy.measurement import PilotScene, measure
    from photonfarm.renderer.strategy.noise import Purpose

    log = partial(print, file=sys.stderr)
    measured = measure(spec, None, Purpose.TRAINING, seconds, log)
    log(f"{spec.name}: weighing {len(measured.rows)} settings in both ways")
    scene = PilotScene(spec, None).on_film(measured.film)
    renders = [kept(render) for render in scene.renders(measured.views)]
    training = measured.model_copy(update={"rows": rows(measured, renders, Purpose.TRAINING, spec.exposure, pairs)})
    weighed = rows(measured, renders, Purpose.IMAGES, spec.exposure, pairs)
    images = measured.model_copy(update={"purpose": Purpose.IMAGES, "rows": weighed})
    return compared(spec, training), compared(spec, images)


def rows(measured: Any, renders: list[Any], purpose: Any, exposure: float, pairs: int) -> tuple[Any, ...]:
    """The measured rows with errors by these renderers as a purpose weighs them; images share no launch."""
    from photonfarm.renderer.strategy.budget import ImageCost
    from photonfarm.renderer.strategy.measurement import CandidateRow
    from photonfarm.renderer.strategy.noise import Purpose
    from photonfarm.renderer.strategy.pilot import Rounds

    candidates = [row.candidate for row in measured.rows]
    rounds = Rounds(renders, candidates, measured.spp, SEED, {}, purpose.weigh(exposure), lambda: 0.0)
    rounds.scout()
    rounds.round(candidates, pairs)
    launches = 1 if purpose is Purpose.TRAINING else 2
    return tuple(
        CandidateRow(
            candidate=row.candidate,
            errors=rounds.errors(row.candidate),
            missed=rounds.missed(row.candidate),
            cost=ImageCost(launches * row.cost.fixed_s, row.cost.sample_s),
        )
        for row in measured.rows
    )


def compared(spec: Any, measurement: Any) -> Compared:
    """The plan that follows from a measurement, and its best settings."""
    from photonfarm.renderer.strategy.plan import best, plan_of

    plan = plan_of(spec, measurement, cached=False)
    return Compared(plan, best({c: at_cost for c, at_cost in plan.at_equal_cost.items() if at_cost.fits}).candidate)


def short(candidate: Any) -> str:
    """A candidate as (connections, light ratio)."""
    samples = f", {candidate.light_samples} light samples" if candidate.light_samples > 1 else ""
    return f"({candidate.connections}, {candidate.light_ratio:g}{', guided' * candidate.guided_light}{samples})"


def line(spec: Any, training: Compared, images: Compared) -> list[Any]:
    """The spec's line of the table."""
    m = training.plan.measurement
    return [
        spec.name,
        f"{m.views} of {m.film.width} × {m.film.height}, {m.spp} spp",
        f"{short(images.best)} → {short(images.plan.candidate)}",
        f"{short(training.best)} → {short(training.plan.candidate)}",
        training.over(images.best),
        images.over(training.best),
    ]


def figures(plan: Any) -> dict[str, Any]:
    """The plan for the JSON file, without what is measured for photons."""
    document = plan.document()
    measured = document.pop("measurement").items()
    return {**document, "measurement": {k: v for k, v in measured if k not in ("near", "power")}}


def page(lines: list[list[Any]], pairs: int) -> str:
    header = ["spec", "views", "for images: best → plan", "for training: best → plan"]
    header += ["for training: images' best takes", "for images: training's best takes"]
    return f"""# Sampling for training, and for images

All settings of `photonfarm scene plan`, (connections, light ratio), by {2 * pairs} images of each in each view, of the
same seeds, weighed once as `--for training` and once as `--for images`; times are measured once. **Best**: the least
error × time. **Plan**: what is proposed, which stays with the spec's settings unless others gain at least 5 % and two
standard errors. **Takes**: the time until the other purpose's best settings reach the error of this purpose's best, ±
one standard error over the views.

{results.table(header, lines)}"""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--spec", nargs="+", default=list(SPECS))
    parser.add_argument("--seconds", type=float, default=SECONDS, help="processor time of the first measurement")
    parser.add_argument("--pairs", type=int, default=PAIRS, help="pairs of images of each setting in each view")
    options = parser.parse_args()
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    lines, plans = [], []
    for name in options.spec:
        spec = ready_spec(name)
        training, images = compare(spec, options.seconds, options.pairs)
        lines.append(line(spec, training, images))
        print(*lines[-1], sep=" | ", file=sys.stderr)
        plans.append({"spec": name, "training": figures(training.plan), "images": figures(images.plan)})
    values = {"seconds": options.seconds, "pairs": options.pairs, "specs": plans}
    results.write("plan_purposes", page(lines, options.pairs), values, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
