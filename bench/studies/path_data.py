"""Training data made by `bdpt` against data made by Mitsuba's `path`, at equal core-seconds of rendering.

    python -m bench.studies.path_data [--experiment fixed-veach-ajar] [--samples 200] [--steps 500] [--seeds 0 1 2 3]
        [--processes 2] [--out docs/results]

Takes the room of an experiment of experiments/, times both integrators, and renders a store of each kind whose
samples cost the same; PHOTONFARM_SCENES names the folder of its scene files. A network is trained alike on
the first samples of either store, for budgets of a quarter to 1 of `bdpt` and of a quarter to 4 of `path`, and
measured on held-out views. Leaves docs/results/path_data_EXPERIMENT.{md,json,png}; what is rendered and trained
stays in build/path_data, and the next call goes on with it. Times are best taken on a quiet machine; the first call
settles what a sample of `path` is. Exit code 0, whatever comes out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from bench.harness import results, room_study
from bench.harness.network_errors import Errors, each_seed
from bench.harness.room_study import ChosenSamples, ReferenceViews, Run, settings_of
from bench.studies import path_data_page, path_scene
from bench.studies.path_data_study import BLOCK, Arm, MeasuredArm, Study, Targets
from bench.studies.path_scene import Rendered
from experiments.experiment import Experiment
from photonfarm.core.errors import SpecError
from photonfarm.core.records import F32
from photonfarm.plan.request import Request
from photonfarm.plan.top_up import TopUp
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneReader

BUDGETS = {"bdpt": (0.25, 0.5, 1.0), "path": (0.25, 0.5, 1.0, 2.0, 4.0)}
HELD_OUT = 1 / 4  # of configurations: with a sixteenth as elsewhere few would be held out from so few samples
HELD_OUT_VIEWS = 48


class FirstSamples(ChosenSamples):
    """The first so many samples of a store that are not held out: those of fewer are among those of more."""

    def __init__(self, root: Path, scene_id: str, samples: int) -> None:
        """Raises ValueError where the store has too few."""
        super().__init__(root, scene_id, HELD_OUT)
        self.chosen = self.trainable[:samples]
        if len(self.chosen) < samples:
            raise ValueError(f"{root} has {len(self.trainable)} samples to train on, and {samples} are needed")


def spec_of(arguments: argparse.Namespace) -> SceneSpec:
    """The spec of an experiment; raises SpecError where there is none, or none of its scene file."""
    return Experiment.load(arguments.experiment, arguments.size).spec()


def requests(arguments: argparse.Namespace) -> dict[str, list[Request | TopUp]]:
    """Half as many configurations again as are trained on, as a quarter of all is held out.

    Both stores begin with the same plan, so that their first samples are of the same views.
    """

    def configurations(share: float) -> Request:
        samples = round(share * arguments.samples)
        return Request(modifications=samples + samples // 2 + 8, seed=arguments.plan_seed)

    first, most = (configurations(shares[-1]) for shares in BUDGETS.values())
    return {
        "bdpt": [
            first,
            TopUp.of(str(arguments.reference_spp), [f"held-out={HELD_OUT}", f"views=first:{HELD_OUT_VIEWS}"]),
        ],
        "path": [first, most],
    }


# ----------------------------------------------------------------------------------------------------------- training


def arms(arguments: argparse.Namespace) -> list[Arm]:
    """Every budget of either kind."""
    return [Arm(kind, share, round(share * arguments.samples)) for kind, shares in BUDGETS.items() for share in shares]


def runs(arm: Arm, made: Rendered, where: tuple[Path, str], arguments: argparse.Namespace) -> list[Run]:
    """The runs of one arm, one from each seed; `where` is the folder and the scene's id."""
    folder, scene_id = where
    source = partial(FirstSamples, made.root, scene_id, arm.samples)
    name = f"{arm.kind}-{made.half_spp}-spp-{arm.samples}"
    return [Run(source, settings_of(arguments, seed, HELD_OUT), folder, name) for seed in arguments.seeds]


def measure(arm: Arm, networks: Sequence[Run], where: tuple[Path, str], references: ReferenceViews) -> MeasuredArm:
    """Look at held-out views with an arm's networks, one from each seed; `where` is bdpt's store and the scene."""
    made = [room_study.images(run.trained(), SceneReader(*where), references.rows) for run in networks]

    def each(error: Callable[[F32], NDArray[np.float64]]) -> Errors:
        return Errors(np.stack([error(images) for images in made]), references.units)

    found = MeasuredArm(
        arm,
        train_s=sum(run.seconds() for run in networks) / len(networks),
        shown=each(references.shown_errors),
        coarse=each(partial(references.shown_errors, block=BLOCK)),
        linear=each(references.linear_errors),
        images=made[0],
    )
    room_study.tell(f"{arm.kind} × {arm.share:g}: {each_seed(found.shown)}")
    return found


# ------------------------------------------------------------------------------------------------------------ targets


def targets(made: dict[str, Rendered], spec: SceneSpec, references: ReferenceViews) -> Targets:
    """What both kinds of samples show of the views that both stores have, as they are before training."""
    sources = {kind: SceneReader(one.root, spec.scene_id) for kind, one in made.items()}
    first = {kind: _first_rows(source) for kind, source in sources.items()}
    held_out = sources["bdpt"].view_keys(list(references.rows))
    common = [view for view in first["bdpt"] if view in first["path"]]
    rows = {kind: [first[kind][view] for view in common] for kind in sources}
    halves = {kind: _halves(source, rows[kind], spec.exposure) for kind, source in sources.items()}
    place = {view: number for number, view in enumerate(common)}
    keys = sources["bdpt"].modification_keys(rows["bdpt"])
    return Targets(halves["bdpt"], halves["path"], tuple(keys), tuple(place[view] for view in held_out))


def _first_rows(source: SceneReader) -> dict[bytes, int]:
    """The first sample of each view, by the view's key."""
    rows = source.refresh().tolist()
    return dict(zip(reversed(source.view_keys(rows)), reversed(rows), strict=True))


def _halves(source: SceneReader, rows: Sequence[int], exposure: float) -> F32:
    """(N, 2, H, W, 3) exposed linear radiance."""
    return np.stack([source.read(row).radiance * np.float32(exposure) for row in rows])


def options() -> argparse.ArgumentParser:
    """The options of the command line."""
    parser = results.parser(__doc__)
    parser.add_argument("--experiment", default="fixed-veach-ajar", help="whose room it is (%(default)s)")
    parser.add_argument("--size", choices=("small", "paper"), default="small", help="of the experiment (%(default)s)")
    parser.add_argument("--samples", type=int, default=200, help="of bdpt, trained on at budget 1 (%(default)s)")
    room_study.add_options(parser, "path_data")
    parser.set_defaults(steps=500, seeds=[0, 1, 2, 3])
    return parser


def main() -> int:
    """Run the benchmark; returns the exit code."""
    parser = options()
    arguments = parser.parse_args()
    try:
        spec = spec_of(arguments)
    except SpecError as error:
        parser.error(str(error))
    if not spec.groups:
        parser.error(f"--experiment {arguments.experiment}: nothing moves in it; intervals need several configurations")
    torch.set_num_threads(1)
    folder, store = room_study.opened(arguments, f"{arguments.experiment}-{spec.scene_id[:8]}-{arguments.samples}")
    costs = path_scene.costs_of(spec, folder)
    made = path_scene.render(spec, (folder, store), requests(arguments), costs, arguments.processes)
    references = ReferenceViews.of(store, spec, arguments.reference_spp, HELD_OUT)
    networks = {arm: runs(arm, made[arm.kind], (folder, spec.scene_id), arguments) for arm in arms(arguments)}
    room_study.train_all([run for arm in reversed(networks) for run in networks[arm]], arguments.processes)
    seen_in = made["bdpt"].root, spec.scene_id
    measured = [measure(arm, of_arm, seen_in, references) for arm, of_arm in networks.items()]
    study = Study(
        arguments, spec, settings_of(arguments, arguments.seeds[0], HELD_OUT), costs, made, references, measured
    )
    looked_at = targets(made, spec, references)
    arguments.out.mkdir(parents=True, exist_ok=True)
    name = f"path_data_{arguments.experiment.replace('-', '_')}"
    path_data_page.picture(study, looked_at).save(arguments.out / f"{name}.png")
    text, values = path_data_page.page(study, looked_at, f"{name}.png"), path_data_page.document(study, looked_at)
    results.write("path_data", text, values, arguments.out, page=name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
