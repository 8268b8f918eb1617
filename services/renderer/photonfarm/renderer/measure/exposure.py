"""`photonfarm scene exposure`: the exposure at which a scene's pictures are as bright, on the average, as is wanted.

How bright they are is their display mean, that of clip(exposure · I, 0, 1)^(1/2.2) over pixels, channels and views. It
grows with the exposure, so bisection finds the exposure in images that are rendered once.

Shape letters: N views, H W image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.estimate import Estimate
from photonfarm.shared.core.pictures import display_values
from photonfarm.shared.core.records import F32
from photonfarm.shared.scene.modification import sample_modification
from photonfarm.shared.scene.spec import Film, SceneSpec
from photonfarm.shared.scene.view import sample_view

TARGET = 0.45
"""Display mean of a picture that is neither dark nor bright."""

FRAMES = 24
"""Views that are rendered, unless told otherwise: they differ more in brightness than noise is worth removing."""

SIDE = 64
"""Pixels along the longer side that are enough: the display mean hardly knows the resolution."""

PATHS = 1 << 17
"""Eye paths of a half of an image: 32 samples per pixel of a square one."""

RANGE = (-40.0, 40.0)
"""Exposures that are looked among, as powers of 2."""

EXACT = 1e-4
"""Width of the powers' range at which the search ends."""

SEED = 0
"""Master seed of configurations and views, as `submit` has it unless told otherwise."""

Talk = Callable[[str], None]
"""Takes a line on what is going on."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """An exposure, and how well it is known."""

    scene_id: str
    target: float  # the display mean that is wanted
    exposure: float  # that gives it
    low: float  # where the mean over the views is a standard error below, and above; None where no exposure gives that
    high: float | None
    standard_error: float  # of the display mean, over views
    noise: float  # by how much noise would lower the display mean; it is taken out
    present: float  # the spec's exposure
    present_mean: float  # the display mean at that
    frames: int
    half_spp: int

    def document(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return asdict(self)

    def line(self) -> str:
        """All of it in words."""
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
        """Of each view, (N,), without noise.

        The display's curve is concave, and so noise lowers the mean, in proportion to its variance where that is small.
        The whole image has half the variance of its halves: by what they are lower, it is itself too low.
        """
        return self.noisy_means(exposure) + self._lowered(exposure)

    def noisy_means(self, exposure: float) -> NDArray[np.float64]:
        """Of each view's whole image, (N,), noise and all."""
        return _means(self.halves.mean(axis=1), exposure)

    def _lowered(self, exposure: float) -> NDArray[np.float64]:
        halves = [_means(self.halves[:, half], exposure) for half in (0, 1)]
        return self.noisy_means(exposure) - np.mean(halves, axis=0)

    def exposure(self, target: float) -> float | None:
        """The one at which the mean over all views is `target`; None where none is high enough."""
        low, high = RANGE
        if self.display_means(2**high).mean() < target:
            return None
        while high - low > EXACT:
            middle = (low + high) / 2
            low, high = (low, middle) if self.display_means(2**middle).mean() >= target else (middle, high)
        return float(2 ** ((low + high) / 2))


def _means(images: F32, exposure: float) -> NDArray[np.float64]:
    shown = display_values((np.float32(exposure) * images).astype(np.float32))
    return shown.mean(axis=(1, 2, 3), dtype=np.float64)


def propose(
    spec: SceneSpec, beside: Path | None, talk: Talk, *, target: float = TARGET, frames: int = FRAMES
) -> Proposal:
    """Render some views, each of a random configuration of its own, and look for the exposure in them.

    The backend must have been loaded. Raises SpecError as loading does, and where too much is black for any exposure.
    """
    small = _small(spec)
    spp = _half_spp(small.film)
    talk(f"rendering {frames} views of {spec.name}, {small.film.width} × {small.film.height}, 2 × {spp} spp")
    pictures = Pictures(np.stack(list(_rendered(LoadedScene.load(small, beside), frames, spp))))
    exposure = pictures.exposure(target)
    if exposure is None:
        reached = pictures.display_means(2 ** RANGE[1]).mean()
        raise SpecError(
            f"{spec.name}: no exposure gives a display mean of {target:g}: too much is black, and the mean stays below "
            f"{reached:.3g}"
        )
    return _proposal(spec, pictures, target, exposure, spp)


def _proposal(spec: SceneSpec, pictures: Pictures, target: float, exposure: float, half_spp: int) -> Proposal:
    means = pictures.display_means(exposure)
    error = Estimate.of(means).standard_error or 0.0
    return Proposal(
        scene_id=spec.scene_id,
        target=target,
        exposure=exposure,
        low=pictures.exposure(target - error) or 0.0,
        high=pictures.exposure(target + error),
        standard_error=error,
        noise=float(np.mean(means - pictures.noisy_means(exposure))),
        present=spec.exposure,
        present_mean=float(pictures.display_means(spec.exposure).mean()),
        frames=len(means),
        half_spp=half_spp,
    )


def _small(spec: SceneSpec) -> SceneSpec:
    """The spec on a film of `SIDE` pixels at most, without photons, and with the same views whatever its exposure."""
    times = -(-max(spec.film.width, spec.film.height) // SIDE)
    width, height = (max(8, side // times // 8 * 8) for side in (spec.film.width, spec.film.height))
    photons = spec.photons.model_copy(update={"paths": 0})
    return spec.model_copy(update={"film": Film(width=width, height=height), "photons": photons, "exposure": 1.0})


def _half_spp(film: Film) -> int:
    return PATHS // (film.width * film.height)


def _rendered(scene: LoadedScene, frames: int, spp: int) -> Iterator[F32]:
    """Two halves of each view, (2, H, W, 3)."""
    spec = scene.spec
    for number in range(frames):
        modification = sample_modification(spec, SEED, number)
        scene.apply(modification)
        view = sample_view(spec, modification.key(spec.scene_id), SEED, number)
        yield scene.render_halves(view, (2 * number, 2 * number + 1), spp)
