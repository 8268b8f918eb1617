"""What an experiment would take, before anything of it is rendered or trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from experiments.experiment import Experiment, Run
from photonfarm.plan.sample_costs import SampleCosts
from photonfarm.scene.spec import SceneSpec

FRAMES = 4
"""Views that a scene's costs are measured on."""

OF_A_STEP = 3
"""A step's operations over those of making the images: once forward, and about twice that backward."""


@dataclass(frozen=True, slots=True)
class Need:
    """Core-hours of rendering on this machine, and operations of training."""

    name: str
    samples: int
    sample_hours: float
    passes: int  # of the references, beside their first, which are among the samples
    pass_hours: float
    runs: int
    operations: float  # floating-point, of all runs

    @classmethod
    def of(cls, experiment: Experiment, costs: SampleCosts) -> Self:
        """Estimate from the costs of the experiment's scene."""
        size, spec = experiment.size, experiment.spec()
        spp = 2 * spec.transport.half_spp
        samples = size.modifications * size.views
        passes = size.references.views * (-(-size.references.spp // spp) - 1)
        of_samples = costs.seconds(spp, configurations=size.modifications, views=samples, samples=samples)
        of_passes = costs.seconds(spp, configurations=0, views=0, samples=passes)
        runs = [*experiment.trained(), *experiment.again()]
        return cls(
            experiment.name,
            samples,
            of_samples / 3600,
            passes,
            of_passes / 3600,
            len(runs),
            sum(count_operations(spec, run) for run in runs),
        )

    def describe(self) -> str:
        """All of it in words."""
        return (
            f"{self.name}: {self.samples:,} samples {self.sample_hours:.1f} core-h; {self.passes:,} further passes for "
            f"references {self.pass_hours:.1f} core-h; {self.runs} runs {self.operations:.2g} operations"
        )


def measure_need(experiment: Experiment) -> Need:
    """What an experiment needs, its scene's costs measured here. Raises SpecError."""
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    from photonfarm.renderer.tools.measure.sample_costs import measure_costs

    return Need.of(experiment, measure_costs(experiment.spec(), frames=FRAMES))


def count_operations(spec: SceneSpec, run: Run) -> float:
    """Floating-point operations of a run's convolutions and matrix products."""
    from photonfarm.trainer.dry_run import summarise
    from photonfarm.trainer.networks import find_kind
    from photonfarm.trainer.runs.settings import make_settings

    changes = {key: value for key, value in run.train.items() if key != "preset"}
    settings = make_settings(run.train["preset"], changes)
    of_image = sum(part.gmacs for part in summarise(spec, settings.network)) * 2e9
    images = settings.batch * (2 if find_kind(settings.network.architecture).needs.kept else 1)  # a denoiser's halves
    return OF_A_STEP * of_image * images * settings.max_steps
