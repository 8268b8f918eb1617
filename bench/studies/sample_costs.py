"""What samples of each experiment's scene cost, how noisy they are, and what that says of samples per pixel.

    python -m bench.studies.sample_costs [--budget 2000] [--views 12] [--out DIR]

Measures the scenes of experiments/ in their small size as `photonfarm scene cost` does, and puts costs and noise into
`photonfarm.plan.allocation`. PHOTONFARM_SCENES names the folder of the scene files. Exit code 0.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass

from bench.harness import results, room_study
from experiments.experiment import list_names
from photonfarm.core.errors import SpecError
from photonfarm.plan.allocation import KAPPA, RHO, Allocation, CostModel
from photonfarm.plan.sample_costs import SampleCosts
from photonfarm.scene.spec import SceneSpec

NAME = "sample_costs"
SPP = (2, 4, 8, 32, 128)


@dataclass(frozen=True, slots=True)
class RoomCosts:
    """A scene, with what was measured."""

    name: str
    spec: SceneSpec
    costs: SampleCosts

    @property
    def terms(self) -> CostModel:
        """What allocations are weighed by."""
        return CostModel.of(self.costs, static=not self.spec.groups)

    def more_than_best(self, spp: int, budget: float) -> float:
        """The factor by which the excess error grows where the budget is spent on single views of so many samples."""
        single = Allocation(1, 1, 1, spp)
        spent = self.terms.excess(single) / (budget / self.terms.seconds(single))
        return spent / self.terms.excess(self.terms.best(budget))


def measured(name: str, views: int) -> RoomCosts:
    """Costs and noise of one experiment's scene. Raises SpecError."""
    from photonfarm.renderer.measure.sample_costs import measured_costs

    spec = room_study.named_room(name)
    room = RoomCosts(name, spec, measured_costs(spec, frames=views))
    room_study.tell(f"{name}: {room.costs.line()}")
    return room


def line(room: RoomCosts, budget: float) -> list[str]:
    """A row of the table."""
    costs, found = room.costs, room.terms.best(budget)
    parts = (costs.configuration_s, costs.view_s, costs.pass_s, costs.spp_s)
    dearer = (f"{room.more_than_best(spp, budget):.2f}" for spp in SPP)
    film = room.spec.film
    return [
        room.name,
        f"{film.width} × {film.height}",
        *(f"{1e3 * part:.1f}" for part in parts),
        f"{costs.relative_variance:.2f}",
        f"{room.terms.best_spp(1):.1f}",
        shared_out(found, static=not room.spec.groups),
        *dearer,
    ]


def shared_out(found: Allocation, *, static: bool) -> str:
    """An allocation in short; a static scene has one configuration, and stands as in `CostModel.of`."""
    parts = (1, found.modifications) if static else (found.modifications, found.views)
    return " × ".join(map(str, parts)) + f" × {found.spp} spp"


def page(rooms: list[RoomCosts], budget: float, views: int) -> str:
    """The table as Markdown."""
    header = (
        "experiment", "image", "configuration, ms", "view, ms", "pass, ms", "1 spp, ms", "relative variance ν of 1 spp",
        "s*", f"best of {budget:g} core-s: configurations × views", *(f"excess at {spp} spp" for spp in SPP),
    )  # fmt: skip
    return f"""# What samples cost, how noisy they are, and how many samples per pixel that asks for

Scenes of `experiments/` in their small size; core-milliseconds, medians over {views} views. ν is the
variance of one sample per pixel over squared brightness (`photonfarm.plan.sample_costs.relative_variance`), from
halves of the scene's samples per pixel, which are stratified: with fewer it is somewhat more. s* is the samples per
pixel, both halves together, of least excess error with one view of each configuration, a guide to a factor of two
([choosing-spp.md](../choosing-spp.md)), and “best” the best of all shares with 2 spp and more
(`photonfarm.plan.allocation`, κ = {KAPPA:g}, ρ = {RHO:g}). The last columns: the excess error of the same
core-seconds spent on single views of so many spp, over that of the best.

{results.table(header, (line(room, budget) for room in rooms))}"""


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = results.parser(__doc__)
    parser.add_argument("--budget", type=float, default=2000.0, help="core-seconds (%(default)s)")
    parser.add_argument("--views", type=int, default=12, help="that are measured of each (%(default)s)")
    options = parser.parse_args()
    try:
        rooms = [measured(name, options.views) for name in list_names()]
    except SpecError as error:
        parser.error(str(error))
    values = {room.name: asdict(room.costs) for room in rooms}
    document = {"budget_core_s": options.budget, "views": options.views, "kappa": KAPPA, "rho": RHO, "rooms": values}
    results.write(NAME, page(rooms, options.budget, options.views), document, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
