#!/usr/bin/env python3
"""What a budget of core-seconds is best spent on: samples per pixel, views of a configuration, or configurations.

    python bench/noise_budget.py [--rooms movable-living-room-2 movable-dining-room] [--budget 200] [--steps 2000]
                                 [--seeds 0 1] [--plan-seed 1] [--out docs/results]

A room is a built-in spec, or an experiment of experiments/ in its small size. Costs and noise are measured as by
`photonfarm scene cost`; each arm of `budget_arms.SHARES` gets as many configurations as the budget pays for, is trained
on from each seed, on other configurations each time, and measured on the same held-out views. The constants of
`photonfarm.shared.allocation` are fitted to all arms of all rooms. What is rendered and trained stays in
build/noise_budget, and the next call goes on with it. PHOTONFARM_SCENES names the folder of the rooms' scene files.
Exit code 0, whatever comes out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

import results
import room_study
from budget_arms import HALF_SPP, SHARES, Arm, Share, requests
from budget_fit import Fit, Point, fit
from photonfarm.shared import allocation
from photonfarm.shared.allocation import Allocation
from photonfarm.shared.errors import SpecError
from photonfarm.shared.sample_costs import SampleCosts
from photonfarm.shared.scene import SceneSpec
from photonfarm.shared.top_up import TopUp
from photonfarm.trainer.store_source import StoreSource
from room_study import HELD_OUT, Errors, References, each_seed, settings_of, stated

ROOMS = ["movable-living-room-2", "movable-dining-room"]
HELD_OUT_VIEWS = 48
ARCHITECTURE = "light_transport"


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
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
class Room:
    """A room with all its arms."""

    name: str
    spec: SceneSpec
    costs: SampleCosts
    references: References
    arms: tuple[Measured, ...]

    def points(self) -> list[Point]:
        """What the model is fitted to."""
        found = []
        for arm in self.arms:
            of = arm.shown.estimate()
            error = of.standard_error or 1.0
            found.append(Point(self.name, arm.allocation, self.costs.relative_noise, of.mean, error))
        return found


def spec_of(room: str) -> SceneSpec:
    """The room, rendered in passes of `2 · HALF_SPP` samples per pixel."""
    return room_study.in_passes(room_study.named_room(room), HALF_SPP)


def measured_room(name: str, told: argparse.Namespace) -> Room:
    """Costs, samples, networks and errors of one room."""
    from photonfarm.renderer.sample_costs import measured_costs

    folder, store = room_study.opened(told, f"{name}-{told.budget:g}-{len(told.seeds)}")
    spec = spec_of(name)
    costs = kept(folder / "costs.json", lambda: measured_costs(room_study.named_room(name)))
    counts = {share: paid(costs, share, told.budget) for share in SHARES}
    held_out = TopUp.of(str(told.reference_spp), [f"held-out={HELD_OUT}", f"views=first:{HELD_OUT_VIEWS}"])
    room_study.render(spec, store, [*requests(counts, len(told.seeds), told.plan_seed), held_out])
    references = References.of(store, spec, told.reference_spp)
    arms = tuple(measure(share, counts[share], (folder, spec), references, told) for share in SHARES)
    return Room(name, spec, costs, references, arms)


def kept(file: Path, make: Any) -> SampleCosts:
    """Costs as they were measured first: what is planned follows from them."""
    if not file.is_file():
        file.write_text(make().json())
    return SampleCosts.read(file.read_text())


def paid(costs: SampleCosts, share: Share, budget: float) -> int:
    """How many configurations the budget pays for."""
    return int(budget / allocation.seconds(costs, Allocation(1, share.views, share.passes, share.spp)))


def measure(
    share: Share, configurations: int, where: tuple[Path, SceneSpec], references: References, told: Any
) -> Measured:
    """Train on one share of the budget from each seed, and look at the held-out views."""
    (folder, spec), made = where, []
    for number, seed in enumerate(told.seeds):
        slice_ = number, len(told.seeds)
        arm = partial(Arm, folder / "store", spec.scene_id, share, configurations, slice_)
        name = f"{share}-{number}-of-{len(told.seeds)}"
        run, _ = room_study.trained(arm, settings_of(ARCHITECTURE, seed, told), folder, name)
        made.append(room_study.images(run, StoreSource(folder / "store", spec.scene_id), references.rows))
    shown = Errors(np.stack([references.shown_errors(images) for images in made]), references.units)
    linear = Errors(np.stack([references.linear_errors(images) for images in made]), references.units)
    room_study.tell(f"{share}: {each_seed(shown)}")
    return Measured(share, configurations, shown, linear)


# --------------------------------------------------------------------------------------------------------------- page


def table(room: Room, found: Fit) -> str:
    """The arms, their errors, and the model's."""
    header = (
        "spp of a sample", "views of a configuration", "passes of a view", "configurations", "samples", "MSE (95 %)",
        "of each seed", "the model's", "linear MSE (95 %)",
    )  # fmt: skip
    predicted = [found.predicted(point) for point in room.points()]
    lines = [
        [
            arm.share.spp, arm.share.views, arm.share.passes, arm.configurations, arm.allocation.samples,
            stated(arm.shown), each_seed(arm.shown), f"{model:.5f}", stated(arm.linear, 3),
        ]
        for arm, model in zip(room.arms, predicted, strict=True)
    ]  # fmt: skip
    return results.table(header, lines)


def pairs_table(room: Room) -> str:
    """Every arm against the best, on the same views."""
    best = min(room.arms, key=lambda arm: arm.shown.estimate().mean)
    lines = []
    for arm in room.arms:
        if arm is not best:
            gap = arm.shown.less(best.shown)
            low, high = gap.interval()
            word = "worse" if low > 0 else "better" if high < 0 else "not told apart"
            lines.append([str(arm.share), stated(gap), each_seed(gap, "+.5f"), word])
    return f"Against `{best.share}`:\n\n" + results.table(("share", "more MSE (95 %)", "of each seed", "it is"), lines)


def optimum(room: Room, found: Fit, budget: float) -> str:
    """What the model says of this room, in words."""
    told = {"kappa": found.kappa, "rho": found.rho}
    best = allocation.best(room.costs, budget, **told)
    real = allocation.best_spp(room.costs, 1, **told)
    return (
        f"By the model the best of {budget:g} core-seconds is {best.modifications} configurations of {best.views} "
        f"views with {best.spp} spp each (s* = {real:.1f} with one view)."
    )


def room_part(room: Room, found: Fit, told: argparse.Namespace) -> str:
    """The page's part on one room."""
    costs, film = room.costs, room.spec.film
    return f"""## {room.name}

{film.width} × {film.height}; a configuration costs {1e3 * costs.configuration_s:.0f} core-milliseconds, a view
{1e3 * costs.view_s:.0f}, a pass {1e3 * costs.pass_s:.0f} and each sample per pixel {1e3 * costs.spp_s:.1f}; relative
noise of one sample per pixel {costs.relative_noise:.2f}. Measured on
{room_study.counted(len(room.references.rows), "view")} of {len(set(room.references.units))} held-out configurations
with references of {room.references.spp} spp.

{table(room, found)}

{pairs_table(room)}

{optimum(room, found, told.budget)}"""


def page(told: argparse.Namespace, rooms: Sequence[Room], found: Fit) -> str:
    """The tables as Markdown."""
    settings = settings_of(ARCHITECTURE, told.seeds[0], told)
    parts = "\n\n".join(room_part(room, found, told) for room in rooms)
    (low, high), (low_rho, high_rho) = found.kappa_range, found.rho_range
    return f"""# What a budget of core-seconds is best spent on

Every arm is rendered for {told.budget:g} core-seconds: configurations, views of each, passes of each view, samples per
pixel (spp) of a pass. `{ARCHITECTURE}`, preset `small`, {told.steps} steps of {settings.batch} samples for each arm
alike; {room_study.described(settings)}.
{room_study.counted(len(told.seeds), "seed")}, of weights and of the order of samples, each with other configurations.

**A sample of s spp** is an image of which each half has s/2; it is put together of passes with {2 * HALF_SPP} spp, and
charged what it costs rendered at once. Passes of a view are samples of their own. **MSE** is in the metric space, the
references' noise taken out; **linear MSE** in exposed linear radiance.
{room_study.of_intervals(len(told.seeds))}

**The model** is that of `photonfarm.shared.allocation`, error = a + b · (ρ/M + (1 + ν/(κ·P·s))/(M·V)), with a and b of
each room and κ and ρ of all: κ = {found.kappa:.3g} ({low:.3g} … {high:.3g}), ρ = {found.rho:.3g} ({low_rho:.3g} …
{high_rho:.3g}), where χ² is up to 1 above the least, {found.chi2:.1f} with {found.freedom} degrees of freedom.

{parts}

{results.footer("noise_budget")}"""


def document(told: argparse.Namespace, rooms: Sequence[Room], found: Fit) -> dict[str, Any]:
    """The figures of noise_budget.json."""
    of_rooms = {
        room.name: {
            "costs": room.costs.json(),
            "reference_spp": room.references.spp,
            "arms": [
                {"share": str(arm.share), "configurations": arm.configurations}
                | {"mse": np.round(arm.shown.values, 6).tolist(), "linear_mse": np.round(arm.linear.values, 6).tolist()}
                for arm in room.arms
            ],
        }
        for room in rooms
    }
    settings = settings_of(ARCHITECTURE, told.seeds[0], told).model_dump(mode="json")
    model = {"kappa": found.kappa, "rho": found.rho, "kappa_range": found.kappa_range, "rho_range": found.rho_range}
    return {"budget_core_s": told.budget, "settings": settings, "model": model, "rooms": of_rooms}


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help="(%(default)s)")
    parser.add_argument("--budget", type=float, default=200.0, help="core-seconds of each arm (200)")
    room_study.add_options(parser, "noise_budget")
    parser.set_defaults(steps=2000, decay=0.88, loss="paired", demodulation=0.2)
    results.add_options(parser)
    told = parser.parse_args()
    torch.set_num_threads(1)
    try:
        rooms = [measured_room(name, told) for name in told.rooms]
    except SpecError as error:
        parser.error(str(error))
    found = fit([point for room in rooms for point in room.points()])
    results.write("noise_budget", page(told, rooms, found), document(told, rooms, found), told.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
