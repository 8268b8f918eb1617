"""`photonfarm scene exposure`: the exposure that gives a scene's pictures a wanted mean brightness.

Brightness is the display mean: the mean of clip(exposure · I, 0, 1)^(1/2.2) over pixels, channels and views, where I is
the radiance. It grows with the exposure, so images are rendered once, and bisection finds their exposure.

Shape letters: N views, H W image.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.core.pictures import display_values
from photonfarm.core.records import F32
from photonfarm.core.statistics import Estimate
from photonfarm.core.waiting import Steps, WorkLog
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.modification import sample_modification
from photonfarm.scene.spec import Film, SceneSpec
from photonfarm.scene.view import sample_view

TARGET = 0.45
"""The display mean of a picture that is neither dark nor bright."""

FRAMES = 48
"""The default number of views. Their differences in brightness make most of the error, so less noise would not help."""

SIDE = 64
"""The pixels along the longer side: the display mean hardly depends on the resolution."""

PATHS = 1 << 16
"""The eye paths of a half of an image: 16 samples per pixel of a square one."""

RANGE = (-40.0, 40.0)
"""The range of the search, as powers of 2."""

EXACT = 1e-4
"""The search ends when its range of powers is no wider than this."""

SEED = 0
"""The master seed of configurations and views, the same as the default of `submit`."""


class DarkError(SpecError):
    """No exposure makes pictures bright: too much of them is black."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """An exposure, and its uncertainty."""

    scene_id: str
    target: float  # the wanted display mean
    exposure: float  # the exposure that gives it
    low: float  # with the mean over the views a standard error lower, and higher; None if no exposure gives that
    high: float | None
    standard_error: float  # of the display mean, over views
    noise: float  # the amount by which noise would lower the display mean; it is taken out
    present: float  # the exposure that the spec has now
    present_mean: float  # the display mean at `present`
    frames: int
    half_spp: int

    def document(self) -> dict[str, Any]:
        """All fields, for JSON."""
        return asdict(self)

    def line(self) -> str:
        """All fields in words."""
        high = "no upper end" if self.high is None else f"{self.high:.3g}"
        return (
            f"exposure {self.exposure:.3g} ({self.low:.3g} … {high}): display mean {self.target:g} ± "
            f"{self.standard_error:.3f}, a standard error of {self.frames} views; the spec's {self.present:g} gives "
            f"{self.present_mean:.3f}; noise would lower the mean by {self.noise:.4f}, and is taken out"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pictures:
    """Rendered views, each in two independent halves."""

    halves: F32  # (N, 2, H, W, 3) linear radiance

    def display_means(self, exposure: float) -> NDArray[np.float64]:
        """The display mean of each view without noise, (N,).

        The display's curve is concave, so noise lowers the mean, in proportion to its variance if that is small. The
        whole image has half the variance of its halves: what they lose against it, it loses against the noise-free
        image.
        """
        whole = self.noisy_means(exposure)
        halves = [_measure_means(self.halves[:, half], exposure) for half in (0, 1)]
        return whole + (whole - np.mean(halves, axis=0))

    def noisy_means(self, exposure: float) -> NDArray[np.float64]:
        """The display mean of each view's whole image with its noise, (N,)."""
        return _measure_means(self.halves.mean(axis=1), exposure)

    def find_exposure(self, target: float) -> float | None:
        """The exposure at which the mean over all views is `target`; None if none is high enough."""
        low, high = RANGE
        if self.display_means(2**high).mean() < target:
            return None
        while high - low > EXACT:
            middle = (low + high) / 2
            low, high = (low, middle) if self.display_means(2**middle).mean() >= target else (middle, high)
        return float(2 ** ((low + high) / 2))


def _measure_means(images: F32, exposure: float) -> NDArray[np.float64]:
    """The display mean of each image (N, H, W, 3), (N,)."""
    shown = display_values((np.float32(exposure) * images).astype(np.float32))
    return shown.mean(axis=(1, 2, 3), dtype=np.float64)


def propose(
    spec: SceneSpec,
    beside: Path | None,
    work: WorkLog,
    *,
    target: float = TARGET,
    frames: int = FRAMES,
    least: float | None = None,
) -> Proposal:
    """Render some views, each of a random configuration of its own, and search for the exposure.

    `scene.backend.load` must have been called. Raises SpecError as loading does, and DarkError if so much is black that
    no exposure reaches the target. Given `least`, it is raised only if less than this share of the pixels is lit;
    otherwise the target holds for the lit pixels.
    """
    small = shrink_film(spec, SIDE).model_copy(update={"exposure": 1.0})  # so that the spec's changes no view
    spp = PATHS // (small.film.width * small.film.height)
    scene, steps = LoadedScene.load(small, beside), Steps(frames, slow=1)
    size = f"{small.film.width} × {small.film.height}"
    work.begin(f"rendering {frames} views of {spec.name}, {size}, 2 × {spp} spp", steps.words)
    pictures = Pictures(np.stack(list(_render_pairs(scene, frames, spp, steps))))
    exposure = pictures.find_exposure(target)
    if exposure is None:
        lit = float(pictures.display_means(2 ** RANGE[1]).mean())  # the share of what is not black: it is white now
        if least is not None and lit >= least:
            exposure = pictures.find_exposure(target * lit)
        if exposure is None or not lit:
            raise DarkError(
                f"{spec.name}: no exposure gives a display mean of {target:g}: too much is black, and the mean stays "
                f"below {lit:.3g}"
            )
        target *= lit
    means = pictures.display_means(exposure)
    error = Estimate.of(means).standard_error or 0.0
    return Proposal(
        scene_id=spec.scene_id,
        target=target,
        exposure=exposure,
        low=pictures.find_exposure(target - error) or 0.0,
        high=pictures.find_exposure(target + error),
        standard_error=error,
        noise=float(np.mean(means - pictures.noisy_means(exposure))),
        present=spec.exposure,
        present_mean=float(pictures.display_means(spec.exposure).mean()),
        frames=len(means),
        half_spp=spp,
    )


def shrink_film(spec: SceneSpec, side: int) -> SceneSpec:
    """The spec without photons, and with a film of at most `side` pixels along its longer side, in multiples of 8."""
    times = -(-max(spec.film.width, spec.film.height) // side)  # rounded up
    width, height = (max(8, pixels // times // 8 * 8) for pixels in (spec.film.width, spec.film.height))
    photons = spec.photons.model_copy(update={"paths": 0})
    return spec.model_copy(update={"film": Film(width=width, height=height), "photons": photons})


def _render_pairs(scene: LoadedScene, frames: int, spp: int, steps: Steps) -> Iterator[F32]:
    """Two halves of each view, (2, H, W, 3)."""
    spec = scene.spec
    for number in range(frames):
        modification = sample_modification(spec, SEED, number)
        scene.apply(modification)
        view = sample_view(spec, modification.key(spec.radiance_id), SEED, number, modification)
        yield scene.render_halves(view, (2 * number, 2 * number + 1), spp)
        steps.reach(number + 1)
