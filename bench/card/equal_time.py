"""Errors of what a frame's time buys: `path`, `bdpt`, and denoised `path`, with inputs and denoising charged.

What is denoised is `bdpt` without light paths, which is `path` in a recorded launch: Mitsuba's own is traced in Python
for each image, which takes longer than the shortest frame. Errors are of clip(exposure · I, 0, 1)^(1/2.2) against two
independent halves of a reference, so that its noise is not in them.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.card.rates import STRATEGIES, make_integrators
from bench.card.rooms import draw_view, load_room, on_card
from bench.harness import results
from photonfarm.core.pictures import display_values
from photonfarm.core.records import F32
from photonfarm.core.statistics import clean_error

if TYPE_CHECKING:
    from photonfarm.renderer.scene.loaded_scene import LoadedScene
    from photonfarm.scene.view import View

TITLE = "Equal time"
FRAMES_MS = (3, 8, 17, 33, 66)
VIEWS, REFERENCE_S, REPETITIONS = 3, 5.0, 3
PLAIN, BDPT = next(iter(STRATEGIES)), "bdpt (1, 1)"
STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
"""The samples per pixel that are chosen among: each number may compile kernels of its own."""

PROBE = 8  # spp: what a sample costs follows from this image and from one of a single sample

Guide = tuple[F32, F32]  # (H, W, 3): albedo or reflectance, and normals
Denoiser = Callable[[F32, F32, F32], F32]


def measure(name: str, size: int, out: Path, _limit_s: float) -> dict[str, Any]:
    """The errors of `path`, `bdpt`, and Open Image Denoise in its qualities, by the time of a frame."""
    denoisers, rendered = load_oidn(), RenderedRoom(name, size, out)
    rows = {method: rendered.errors(method) for method in ("path", BDPT, PLAIN)}
    for label, denoise, guide in denoisers:
        rows[label] = rendered.errors(PLAIN, denoise, guide)
    return {"size": size, "rows": rows}


class RenderedRoom:
    """A room in a configuration, with some views, references of them, and the integrators that are compared."""

    def __init__(self, name: str, size: int, out: Path) -> None:
        self.scene = load_room(name, size, 1)
        self.integrators = make_integrators()
        self.views = [draw_view(self.scene, 0, number)[2] for number in range(VIEWS)]
        self.scene.apply(draw_view(self.scene, 0)[0])
        if not (file := out / f"reference-{name}-{size}.npy").is_file():
            np.save(part := file.with_suffix(".part.npy"), self._render_references())
            part.rename(file)
        self.references: F32 = np.load(file)
        self.made: dict[tuple[str, int], tuple[float, list[F32]]] = {}  # seconds and images, by method and spp

    def _render_references(self) -> F32:
        """Two independent halves of each view, (VIEWS, 2, H, W, 3), displayed."""
        shown = []
        for number, view in enumerate(self.views):
            sums, count, until = np.zeros((2, 1, 1, 1), np.float32), 0, time.perf_counter() + REFERENCE_S
            while count < 4 or time.perf_counter() < until:
                seed = 1 << 20 | number << 16 | count
                one = partial(self.scene.render, view, integrator=self.integrators[BDPT], spp=64)
                sums, count = sums + np.stack([one(2 * seed), one(2 * seed + 1)]), count + 1
            shown.append(self.display((sums / count).astype(np.float32)))
        return np.stack(shown)

    def display(self, image: F32) -> F32:
        """The values that a display is given."""
        return display_values((np.float32(self.scene.spec.exposure) * image).astype(np.float32))

    def render(self, method: str, spp: int) -> tuple[float, list[F32]]:
        """Seconds of an image of so many samples per pixel, and one of each view."""
        if (method, spp) not in self.made:
            render = partial(self.scene.render, integrator=self.integrators[method], spp=spp)
            for seed in (0, 1):  # compiles, and may record once more
                render(self.views[0], seed)
            timed = [timed_s(partial(render, view, 2 + seed)) for seed in range(REPETITIONS) for view in self.views]
            self.made[method, spp] = statistics.median(s for s, _ in timed), [image for _, image in timed[:VIEWS]]
        return self.made[method, spp]

    def errors(
        self,
        method: str,
        denoise: Denoiser | None = None,
        guide: Callable[[LoadedScene, View], Guide] | None = None,
        frames_ms: Sequence[float] = FRAMES_MS,
    ) -> dict[str, Any]:
        """The samples per pixel that fit each frame's time, the time that they take, and the error."""
        guides: Sequence[Guide] = ()
        further_s = 0.0
        if denoise is not None and guide is not None:
            guide(self.scene, self.views[0])  # compiles
            inputs_s, guides = zip(*(timed_s(partial(guide, self.scene, view)) for view in self.views), strict=True)
            once = partial(denoise, self.render(method, 1)[1][0], *guides[0])
            once()
            denoised_s = statistics.median(timed_s(once)[0] for _ in range(REPETITIONS))
            further_s = statistics.median(inputs_s) + denoised_s
        rows: dict[str, Any] = {}
        for frame_ms in frames_ms:
            spp = self._most_spp(method, 1e-3 * frame_ms - further_s)
            if not spp:
                continue
            took_s, images = self.render(method, spp)
            if denoise is not None:
                images = [denoise(image, *with_) for image, with_ in zip(images, guides, strict=True)]
            errors = [
                clean_error(self.display(image), *halves) for image, halves in zip(images, self.references, strict=True)
            ]
            rows[str(frame_ms)] = {"spp": spp, "ms": 1e3 * (took_s + further_s), "mse": statistics.fmean(errors)}
        return {"further_ms": 1e3 * further_s, "frames": rows}

    def _most_spp(self, method: str, left_s: float) -> int:
        """The most samples per pixel that take no longer than this; 0 if one does."""
        one, probe = (self.render(method, spp)[0] for spp in (1, PROBE))
        each = (probe - one) / (PROBE - 1)
        fitting = (spp for spp in reversed(STEPS) if one + (spp - 1) * each <= left_s)
        return next((spp for spp in fitting if self.render(method, spp)[0] <= left_s), 0)


def timed_s(work: Callable[[], Any]) -> tuple[float, Any]:
    """The seconds of some work, of the processor where that renders, and its result."""
    from photonfarm.renderer.scene import backend

    began = backend.work_s()
    found = work()
    return backend.work_s() - began, found


def guide_by_albedo(scene: LoadedScene, view: View) -> Guide:
    """Diffuse albedo and normals, as the product feeds its denoisers."""
    buffers = scene.buffers(view)
    return np.clip(buffers.albedo, 0, 1), buffers.normal


def guide_by_reflectance(scene: LoadedScene, view: View) -> Guide:
    """The reflectance of all lobes, also in mirrors, 1 on lamps; from guides that are rendered without shadow rays."""
    import torch

    from photonfarm.trainer.networks.inputs import SURFACE, SurfaceInputs, replace_albedo

    none = np.zeros((1, 3), np.float32)
    ((buffers, guides),) = scene.inputs([view], [bytes(16)], scene.spec.guides.without_shadows(), (none, none + 1))
    surface = SurfaceInputs(**{name: torch.from_numpy(getattr(guides, name)) for name in SURFACE})
    return replace_albedo(torch.from_numpy(buffers.albedo), surface).numpy(), buffers.normal


def load_oidn() -> list[tuple[str, Denoiser, Callable[[LoadedScene, View], Guide]]]:
    """Open Image Denoise on the device that renders, by label. Raises SpecError where it is not installed."""
    import torch

    from photonfarm.trainer.predictors.denoisers import OIDN, Oidn

    device = torch.device("cuda" if on_card() else "cpu")

    def with_quality(oidn: Oidn) -> Denoiser:
        return lambda *images: oidn.denoise(*(torch.from_numpy(image).to(device) for image in images)).cpu().numpy()

    fed = {True: guide_by_reflectance, False: guide_by_albedo}
    return [
        (label, with_quality(Oidn(1, device, quality)), fed[label.endswith("reflectance")])
        for label, quality in OIDN.items()
    ]


def describe(found: Mapping[str, Mapping[str, Any]]) -> str:
    """A table for each room."""
    parts = [__doc__.split("\n\n", 1)[1].strip()] if __doc__ else []
    for name, of in found.items():
        lines = []
        for label, row in of["rows"].items():
            frames = [row["frames"].get(str(ms)) for ms in FRAMES_MS]
            cells = [f"{frame['mse']:.5f} ({frame['spp']})" if frame else "–" for frame in frames]
            lines.append([label, f"{row['further_ms']:.1f}", *cells])
        header = ("", "inputs and denoising, ms", *(f"MSE (spp) in {ms} ms" for ms in FRAMES_MS))
        parts.append(f"`{name}`, {VIEWS} views of {of['size']}²:\n\n{results.table(header, lines)}")
    return "\n\n".join(parts)
