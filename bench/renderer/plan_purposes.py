"""Which sampling `scene plan` proposes for training and for images, and what one loses by the other's choice.

    python -m bench.renderer.plan_purposes [--spec room cornell …] [--seconds 60] [--out DIR]

Each spec is measured anew for either purpose, with the same views and seeds.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from typing import Any

from bench.harness import results
from bench.harness.scenes import ready_spec

SPECS = ("room", "cornell", "living-room-2", "veach-ajar")
SECONDS = 60.0


@dataclass(frozen=True, slots=True)
class Planned:
    """A plan for one purpose."""

    plan: Any
    best: Any  # the candidate with the least error × time among those measured longest
    best_alone: Any  # the same if only the time of images counted

    def over(self, other: Any) -> str:
        """How much longer another candidate takes to the same error than the best, in words."""
        from photonfarm.renderer.strategy.comparison import saving
        from photonfarm.renderer.strategy.reasons import plus_minus

        if other == self.best:
            return "1"
        found = saving(self.plan.at_equal_cost[self.best], over=self.plan.at_equal_cost[other])
        return plus_minus(found.factor, found.spread)


def planned(spec: Any, purpose: Any, seconds: float) -> Planned:
    """The plan of a spec for a purpose, measured now."""
    from photonfarm.renderer.strategy.measurement import measure
    from photonfarm.renderer.strategy.plan import plan_of

    found = measure(spec, None, purpose, seconds, partial(print, file=sys.stderr))
    plan = plan_of(spec, found, cached=False)
    alone = plan_of(spec, found.model_copy(update={"configuration_s": 0.0, "view_s": 0.0}), cached=False)
    return Planned(plan, best_of(plan), best_of(alone))


def best_of(plan: Any) -> Any:
    """The candidate with the least error × time among those that fit the cost and were measured longest."""
    from photonfarm.renderer.strategy.choices import best

    return best({c: at_cost for c, at_cost in plan.at_equal_cost.items() if at_cost.fits}).candidate


def short(candidate: Any) -> str:
    """A candidate as (connections, light ratio)."""
    return f"({candidate.connections}, {candidate.light_ratio:g})"


def line(spec: Any, training: Planned, images: Planned) -> list[Any]:
    """The spec's line of the table."""
    m = training.plan.measurement
    halves_s = 2 * m.half_s
    return [
        spec.name,
        f"{m.views} of {m.film.width}×{m.film.height}, {m.spp} spp",
        f"{short(images.best)} → {short(images.plan.candidate)}",
        f"{short(training.best)} → {short(training.plan.candidate)}",
        training.over(images.best),
        images.over(training.best),
        short(training.best_alone),
        f"{1e3 * (m.configuration_s + m.view_s):.0f} + {1e3 * halves_s:.0f}",
    ]


def summary(spec: Any, training: Planned, images: Planned) -> dict[str, Any]:
    """The plans of a spec for the JSON file."""
    return {"spec": spec.name, "training": training.plan.document(), "images": images.plan.document()}


def page(lines: list[list[Any]], seconds: float) -> str:
    header = ["spec", "views", "for images: best → plan", "for training: best → plan"]
    header += ["for training: images' best takes", "for images: training's best takes"]
    header += ["for training, images' time alone: best", "ms of a sample: beside + both halves"]
    return f"""# Sampling for training, and for images

`photonfarm scene plan --for training` and `--for images`, {seconds:g} s of processor time each, measured anew with the
same views and seeds. Settings are (connections, light ratio). **Best**: the least error × time among those that were
measured longest. **Plan**: what is proposed, which stays with the spec's settings unless others gain at least 5 % and
two standard errors. **Takes**: the time until the other purpose's best settings reach the error of this purpose's best,
± one standard error over the views. **Images' time alone**: the best for training if what a sample takes beside its
half-estimates did not count.

{results.table(header, lines)}"""


def main() -> int:
    parser = results.parser(__doc__)
    parser.add_argument("--spec", nargs="+", default=list(SPECS))
    parser.add_argument("--seconds", type=float, default=SECONDS, help="processor time of each measurement")
    options = parser.parse_args()
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    from photonfarm.renderer.strategy.objective.purpose import Purpose

    measured = []
    for name in options.spec:
        spec = ready_spec(name)
        training, images = (planned(spec, purpose, options.seconds) for purpose in (Purpose.TRAINING, Purpose.IMAGES))
        measured.append((spec, training, images))
    text = page([line(*found) for found in measured], options.seconds)
    values = {"seconds": options.seconds, "specs": [summary(*found) for found in measured]}
    results.write("plan_purposes", text, values, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
