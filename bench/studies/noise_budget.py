"""What a budget of core-seconds is best spent on: samples per pixel, views of a configuration, or configurations.

    python -m bench.studies.noise_budget [--rooms movable-living-room-2 movable-dining-room] [--budget 200]
        [--steps 1000] [--seeds 0 1] [--plan-seed 1] [--processes 2] [--out docs/results]

A room is a built-in spec, or an experiment of experiments/ in its small size. Costs and noise are measured as by
`photonfarm scene cost`, best on a quiet machine; each arm of `budget_arms.SHARES` gets as many configurations as the
budget pays for, is trained on from each seed, on other configurations each time, and measured on the same held-out
views. The constants of `photonfarm.plan.allocation` are fitted to all arms of all rooms. What is rendered and
trained stays in build/noise_budget, and the next call goes on with it. PHOTONFARM_SCENES names the folder of the
rooms' scene files. Exit code 0, whatever comes out.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bench.harness import results, room_study
from bench.harness.network_errors import F64, Errors, each_seed, of_intervals, stated, within
from bench.harness.room_study import HELD_OUT, ReferenceViews, Run, in_processes, settings_of
from bench.harness.scenes import in_passes
from bench.studies.budget_arms import HALF_SPP, SHARES, ArmSamples, Share, requests
from bench.studies.budget_fit import KAPPAS, RHOS, Fit, RoomErrors, fit
from photonfarm.core.errors import SpecError
from photonfarm.core.files import write_whole
from photonfarm.plan.allocation import Allocation, CostModel, seconds
from photonfarm.plan.request import Request
from photonfarm.plan.sample_costs import SampleCosts
from photonfarm.plan.top_up import TopUp
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneReader, Store

ROOMS = ["movable-living-room-2", "movable-dining-room"]
HELD_OUT_VIEWS = 48
TIMED_VIEWS = 16


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredShare:
    """Networks of one share of the budget, one from each seed."""

    share: Share
    configurations: int
    shown: Errors  # squared, in the metric space
    linear: Errors  # squared, in exposed linear radiance

    @property
    def allocation(self) -> Allocation:
        """What was paid for."""
        return Allocation(self.configurations, self.share.views, self.share.passes, self.share.spp)


@dataclass(frozen=True, slots=True, eq=False)
class BudgetStudy:
    """A room with all its arms."""

    name: str
    spec: SceneSpec
    costs: SampleCosts
    references: ReferenceViews
    arms: tuple[MeasuredShare, ...]
    errors: RoomErrors  # of the arms, in their order


def spec_of(room: str) -> SceneSpec:
    """The room, rendered in passes of `2 · HALF_SPP` samples per pixel."""
    return in_passes(room_study.named_room(room), HALF_SPP)


@dataclass(frozen=True, slots=True, eq=False)
class Planned:
    """A room, and what is going to be bought of it."""

    name: str
    spec: SceneSpec
    folder: Path
    store: Store
    costs: SampleCosts
    counts: dict[Share, int]  # configurations


def planned(name: str, arguments: argparse.Namespace) -> Planned:
    """Costs are as they were measured first. Raises SpecError, and ValueError where a share buys nothing."""
    spec = spec_of(name)
    folder, store = room_study.opened(
        arguments, f"{name}-{spec.scene_id[:8]}-{arguments.budget:g}-{len(arguments.seeds)}"
    )
    file = folder / "costs.json"
    if not file.is_file():
        (costs,) = in_processes(times_and_noise, [(room_study.named_room(name),)], 1, f"{name}: measured costs")
        write_whole(file, costs.json())
    costs = SampleCosts.read(file.read_text())
    return Planned(name, spec, folder, store, costs, {share: paid(costs, share, arguments.budget) for share in SHARES})


def times_and_noise(room: SceneSpec) -> SampleCosts:
    """Times at the samples per pixel that the room has, and the noise of the passes that samples are made of."""
    from photonfarm.renderer.measure.sample_costs import measured_costs

    passes = measured_costs(in_passes(room, HALF_SPP), frames=TIMED_VIEWS)
    return replace(measured_costs(room, frames=TIMED_VIEWS), relative_variance=passes.relative_variance)


def paid(costs: SampleCosts, share: Share, budget: float) -> int:
    """How many configurations the budget pays for; raises ValueError where that is none."""
    one = seconds(costs, Allocation(1, share.views, share.passes, share.spp))
    if one > budget:
        raise ValueError(f"--budget {budget:g}: a configuration of {share} costs {one:.2f} core-seconds; give more")
    return int(budget / one)


def measured_room(number: int, plan: Planned, arguments: argparse.Namespace) -> BudgetStudy:
    """Samples, networks and errors of one room, which has a number among all."""
    held_out = TopUp.of(str(arguments.reference_spp), [f"held-out={HELD_OUT}", f"views=first:{HELD_OUT_VIEWS}"])
    asked: list[Request | TopUp] = [*requests(plan.counts, len(arguments.seeds), arguments.plan_seed), held_out]
    room_study.render(plan.spec, plan.store, asked, arguments.processes)
    references = ReferenceViews.of(plan.store, plan.spec, arguments.reference_spp)
    networks = {share: runs(share, plan, arguments) for share in SHARES}
    room_study.train_all([run for of_share in networks.values() for run in of_share], arguments.processes)
    arms = tuple(measure(share, plan, networks[share], references) for share in SHARES)
    shown = [(arm.allocation, arm.shown) for arm in arms]
    errors = RoomErrors.of(plan.name, plan.costs.relative_variance, shown, number)
    return BudgetStudy(plan.name, plan.spec, plan.costs, references, arms, errors)


def runs(share: Share, plan: Planned, arguments: argparse.Namespace) -> list[Run]:
    """The runs of one share of the budget, one from each seed."""
    found = []
    for number, seed in enumerate(arguments.seeds):
        slice_ = number, len(arguments.seeds)
        source = partial(ArmSamples, plan.folder / "store", plan.spec.scene_id, share, plan.counts[share], slice_)
        name = f"{share}-{number}-of-{len(arguments.seeds)}"
        found.append(Run(source, settings_of(arguments, seed), plan.folder, name))
    return found


def measure(share: Share, plan: Planned, networks: Sequence[Run], references: ReferenceViews) -> MeasuredShare:
    """Look at the held-out views with networks that are trained on one share of the budget."""
    where = plan.folder / "store", plan.spec.scene_id
    made = [room_study.images(run.trained(), SceneReader(*where), references.rows) for run in networks]
    shown = Errors(np.stack([references.shown_errors(images) for images in made]), references.units)
    linear = Errors(np.stack([references.linear_errors(images) for images in made]), references.units)
    room_study.tell(f"{share}: {each_seed(shown)}")
    return MeasuredShare(share, plan.counts[share], shown, linear)


# --------------------------------------------------------------------------------------------------------------- page


def table(room: BudgetStudy, found: Fit) -> str:
    """The arms, their errors, and the model's."""
    header = (
        "spp of a sample", "views of a configuration", "passes of a view", "configurations", "samples", "MSE (95 %)",
        "of each seed", "the model's", "linear MSE (95 %)",
    )  # fmt: skip
    predicted = found.predicted(room.errors)
    lines = [
        [
            arm.share.spp, arm.share.views, arm.share.passes, arm.configurations, arm.allocation.samples,
            stated(arm.shown), each_seed(arm.shown), f"{model:.5f}", stated(arm.linear, 3),
        ]
        for arm, model in zip(room.arms, predicted, strict=True)
    ]  # fmt: skip
    return results.table(header, lines)


def pairs_table(room: BudgetStudy) -> str:
    """Every arm against the best, on the same views."""
    best = min(room.arms, key=lambda arm: arm.shown.estimate().mean)
    lines = []
    for arm in room.arms:
        if arm is not best:
            gap = arm.shown.less(best.shown)
            low, high = gap.interval()
            word = "worse" if low > 0 else "better" if high < 0 else "not told apart"
            lines.append([str(arm.share), stated(gap), each_seed(gap, "+.5f"), word])
    said = f"Against `{best.share}`, which was picked for its low error, each by an interval of its own:\n\n"
    return said + results.table(("share", "more MSE (95 %)", "of each seed", "it is"), lines)


def levels(room: BudgetStudy, found: Fit) -> str:
    """What of the errors the model takes for excess, which alone the shares of a budget change, in words."""
    a, b = found.levels[room.name]
    beyond = [(model - a) / model for model in found.predicted(room.errors)]
    below = sum(arm.shown.estimate().mean < a for arm in room.arms)
    return (
        f"By the model endless data would leave a = {a:.5f}, and b = {b:.5f}: of the MSE that it gives an arm "
        f"{min(beyond):.0%} to {max(beyond):.0%} is excess, which is all that a budget and its shares can change. a is "
        f"fitted, without an interval; {below} of the {len(room.arms)} arms were measured below it."
    )


def optimum(room: BudgetStudy, found: Fit, budget: float) -> str:
    """What was measured to be best in this room, and what the model says is, in words."""
    first, of_arms = room.errors.best()
    terms = CostModel(room.costs, found.kappa, found.rho)
    best, real = terms.best(budget), terms.best_spp(1)
    low, high = within(np.array([CostModel(room.costs, kappa, rho).best_spp(1) for kappa, rho in found.constants]))
    bought = best_of_replicates(room, found, budget)
    return (
        f"Measured best: `{room.arms[first].share}`, the best in {of_arms[first]:.0%} of replicates. By the model the "
        f"best of {budget:g} core-seconds is {best.modifications} configurations of "
        f"{room_study.counted(best.views, 'view')} with {best.spp} spp each; with one view "
        f"s* = {real:.2f} ({low:.2f} … {high:.2f}). Of the replicates' κ and ρ the best has "
        f"{shares([of.spp for of in bought], 'spp')}; and {shares([of.views for of in bought], 'views')}."
    )


def best_of_replicates(room: BudgetStudy, found: Fit, budget: float) -> list[Allocation]:
    """What the model says is best in a room, by the constants of each replicate."""
    best = cache(lambda kappa, rho: CostModel(room.costs, kappa, rho).best(budget))
    return [best(kappa, rho) for kappa, rho in found.constants]


def shares(values: Sequence[int], what: str) -> str:
    """How often which number occurs, in words, the most frequent first."""
    counted = Counter(values).most_common()
    return ", ".join(f"{value} {what} in {count / len(values):.0%}" for value, count in counted)


def in_range(low: float, high: float, grid: F64) -> str:
    """A range of a constant, and where the grid that was searched ends it."""
    below = " or less" if low == grid[0] > 0 else ""
    return f"{low:.3g}{below} … {high:.3g}{' or more' if high == grid[-1] else ''}"


def room_part(room: BudgetStudy, found: Fit, arguments: argparse.Namespace) -> str:
    """The page's part on one room."""
    costs, film = room.costs, room.spec.film
    return f"""## {room.name}

{film.width} × {film.height}; a configuration costs {1e3 * costs.configuration_s:.0f} core-milliseconds, a view
{1e3 * costs.view_s:.0f}, a pass {1e3 * costs.pass_s:.0f} and each sample per pixel {1e3 * costs.spp_s:.1f}; relative
variance of one sample per pixel {costs.relative_variance:.2f}. Measured on
{room_study.counted(len(room.references.rows), "view")} of {len(set(room.references.units))} held-out configurations
with references of {room.references.spp} spp.

{table(room, found)}

{levels(room, found)}

{pairs_table(room)}

{optimum(room, found, arguments.budget)}"""


def page(arguments: argparse.Namespace, rooms: Sequence[BudgetStudy], found: Fit) -> str:
    """The tables as Markdown."""
    settings = settings_of(arguments, arguments.seeds[0])
    parts = "\n\n".join(room_part(room, found, arguments) for room in rooms)
    seeds = room_study.counted(len(arguments.seeds), "seed")
    kappas, rhos = in_range(*found.kappa_range, KAPPAS), in_range(*found.rho_range, RHOS)
    return f"""# What a budget of core-seconds is best spent on

Every arm is charged {arguments.budget:g} core-seconds of rendering: configurations, views of each, passes of each view,
samples per pixel (spp) of a pass. For each arm alike {room_study.described(settings)}.
{seeds}, of weights and of the order of samples, each with other configurations.

**A sample of s spp** is an image of which each half has s/2. It is put together of independent passes with
{2 * HALF_SPP} spp, so that its noise falls with 1/s: rendered at once it would be stratified, and less noisy. It is
charged what it would cost rendered at once, by a line through the times of two numbers of spp; the variance given
below, relative to squared brightness (`photonfarm.plan.sample_costs.relative_variance`), is that of the
passes. Passes of a view are samples of their own. **MSE** is in the metric space, the references' noise taken out;
**linear MSE** in exposed linear radiance.
{of_intervals(len(arguments.seeds))}

**The model** is that of `photonfarm.plan.allocation`, error = a + b · (ρ/M + (1 + ν/(κ·P·s))/(M·V)), with a and
b of each room and κ and ρ of all: κ = {found.kappa:.3g} ({kappas}), ρ = {found.rho:.3g} ({rhos}); χ² is
{found.chi2:.1f} with {found.freedom} degrees of freedom. Arms are weighted by standard errors without what the arms
of a room have in common, which a and b absorb: how hard a configuration is, as a share of the mean. Ranges are 95 %
intervals of a bootstrap of {len(found.kappas)} replicates, each fitted anew: held-out configurations drawn with
replacement, the same for all arms of a room, and each arm's mean moved by a normal deviate of what seeds move it,
pooled over its room. These deviates are drawn independently, though arms of one seed are not quite that: the
configurations of those with few are among those of the others. Where a range reaches the end of the grid that was
searched, "or more", "or less", the data do not bound the constant at that end, and its best value says little.

{parts}"""


def document(arguments: argparse.Namespace, rooms: Sequence[BudgetStudy], found: Fit) -> dict[str, Any]:
    """The figures of noise_budget.json."""
    settings = settings_of(arguments, arguments.seeds[0])
    of_rooms = {
        room.name: room_study.document(settings, arguments, room.references)
        | {
            "costs": asdict(room.costs),
            "arms": [
                {**asdict(arm.share), "configurations": arm.configurations}
                | {"mse": np.round(arm.shown.values, 6).tolist(), "linear_mse": np.round(arm.linear.values, 6).tolist()}
                for arm in room.arms
            ],
        }
        for room in rooms
    }
    model = {"kappa": found.kappa, "rho": found.rho, "kappa_range": found.kappa_range, "rho_range": found.rho_range}
    model |= {"levels": found.levels, "chi2": found.chi2, "freedom": found.freedom}
    return {"budget_core_s": arguments.budget, "model": model, "rooms": of_rooms}


def options() -> argparse.ArgumentParser:
    """The options of the command line."""
    parser = results.parser(__doc__)
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help="(%(default)s)")
    parser.add_argument("--budget", type=float, default=200.0, help="core-seconds of each arm (200)")
    room_study.add_options(parser, "noise_budget")
    parser.set_defaults(steps=1000)
    return parser


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = options()
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    try:
        plans = [planned(name, arguments) for name in arguments.rooms]
    except (SpecError, ValueError) as error:
        parser.error(str(error))
    rooms = [measured_room(number, plan, arguments) for number, plan in enumerate(plans)]
    found = fit([room.errors for room in rooms])
    results.write("noise_budget", page(arguments, rooms, found), document(arguments, rooms, found), arguments.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
