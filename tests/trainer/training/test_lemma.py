"""Lemma 1 on a rendered scene [supplement 3.2]: noisy targets give, on average, the gradient of the clean image.

The room with objects moved and turned, and lights moved, a view at 32², and a network that has been trained a little,
so that no gradient is zero. K noisy targets and R converged ones have seeds of their own. For each weight tensor, and
for all of them as one, the statistic is t = |ḡ − ḡ*| / σ: ḡ is the mean gradient over the K noisy targets, ḡ* that over
the R converged ones, and σ² = tr Σ/K + tr Σ*/R what |ḡ − ḡ*|² is by noise alone. Without bias t² is a weighted sum of
χ² of mean 1, so that P(t > 3) ≤ P(χ²₁ > 9) = 0.0027 for each tensor (Székely and Bakirov 2003). Seeds are fixed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from photonfarm.core.keys import view_key
from photonfarm.core.records import F32, BasePointCloud, Geometry
from photonfarm.data.torch_dataset import SampleTensors
from photonfarm.renderer.jobs.estimates import photons_of
from photonfarm.renderer.jobs.render import lit_points, visibility_of
from photonfarm.renderer.scene import backend
from photonfarm.renderer.scene.loaded_scene import LoadedScene
from photonfarm.scene.groups import Turn
from photonfarm.scene.modification import rebuild, sample_modification
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.scene.view import View, sample_view
from photonfarm.store import Sample
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import ARCHITECTURES, build
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.settings import Architecture, NetworkSettings, TrainSettings
from photonfarm.trainer.training.learner import build_optimiser
from photonfarm.trainer.training.losses import LOSSES, paired_loss

SIZE, POINTS = 32, 1024
K = 336  # noisy targets, of one sample in each half
R, CONVERGED = 8, 64  # converged targets, and samples in each half of one
TRAINED_ON, WARM_UP = 16, 100  # noisy targets of their own for the steps before gradients are taken; how many steps
AT_ONCE = 64  # renders a call, so that one kernel does for all

Loss = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Rendered:
    """A batch of one with a network, and targets (n, 1, 2, H, W, 3) for it, linear radiance × exposure."""

    batch: TrainingBatch
    network: Network
    noisy: Tensor
    converged: Tensor


@dataclass(frozen=True)
class Seen:
    """A view of the room with everything that any network is told of it, and its targets."""

    spec: SceneSpec
    base: tuple[Geometry, BasePointCloud]
    sample: Sample
    noisy: F32
    converged: F32


@pytest.fixture(scope="module")
def seen() -> Seen:
    torch.set_num_threads(1)
    backend.load(threads=1)
    room = load_spec("room")
    film = room.film.model_copy(update={"width": SIZE, "height": SIZE})
    transport = room.transport.model_copy(update={"half_spp": 1})
    photons = room.photons.model_copy(update={"paths": 512})
    objects = tuple(each.model_copy(update={"turn": Turn(min=-180, max=180)}) for each in room.objects)
    changes = {"film": film, "transport": transport, "photons": photons, "points": POINTS}
    spec = room.model_copy(update={**changes, "objects": objects})
    scene = LoadedScene.load(spec)
    base = scene.base()
    modification = sample_modification(spec, 0, 2)
    key = modification.key(spec.radiance_id)
    view = sample_view(spec, key, 0, 2)
    scene.apply(modification)
    traced, _ = photons_of(scene, key)
    assert traced is not None

    noisy = targets(scene, view, K + TRAINED_ON, samples=1, seed=1_000_000)
    converged = targets(scene, view, R, samples=CONVERGED, seed=2_000_000)
    (visible,) = visibility_of(scene, [view], rebuild(base[1], modification), traced)
    lit = lit_points(base[1], modification)
    ((buffers, guides),) = scene.inputs([view], [view_key(key, view.vector)], spec.guides, lit)
    of_view = buffers, visible, guides
    shared = (lambda: base[1]), (lambda: traced)
    sample = Sample(0, key, modification, view, 0, noisy[0, 0], *of_view, 1.0, *shared)
    noisy, converged = (x * np.float32(spec.exposure) for x in (noisy, converged))
    return Seen(spec, base, sample, noisy, converged)


@pytest.fixture(scope="module")
def rendered(seen: Seen) -> Rendered:
    return of_architecture(seen, "light_transport")


def of_architecture(seen: Seen, architecture: Architecture, passes: int = 1) -> Rendered:
    """A network that has been trained a little, and what it sees; of a half so many passes that are no targets here.

    Of the guided ones, guided_transport and guided_denoise filter their direct light.
    """
    filters = architecture in ("guided_transport", "guided_denoise")
    network_settings = NetworkSettings(architecture=architecture, width=8, least_specular=0.04, filter_direct=filters)
    tensors = SampleTensors(seen.spec, ARCHITECTURES[architecture].needs.fields, exposure=seen.spec.exposure)
    memory = tensors.empty(1)
    tensors.fill(memory, 0, seen.sample)
    kept = torch.ones(1, SIZE, SIZE, dtype=torch.bool) if ARCHITECTURES[architecture].needs.kept else None
    several = None
    if passes > 1:
        halves = torch.from_numpy(seen.noisy[K : K + passes, 0])
        memory["radiance"][0] = halves.mean(dim=0)
        several = torch.tensor([float(passes)]), halves.mean(dim=-1).var(dim=0)[None] / passes
    batch = TrainingBatch.of((0,), (seen.sample.key,), memory, kept, several)
    settings = TrainSettings(network=network_settings, learning_rate=2e-3)
    network = build(settings.network, SceneFrame.of(seen.spec, *seen.base, settings.network), 0)
    noisy, converged = torch.from_numpy(seen.noisy), torch.from_numpy(seen.converged)
    warm_up(network, settings, batch, noisy[K:])
    return Rendered(batch, network, noisy[:K], converged)


def targets(scene: LoadedScene, view: View, count: int, *, samples: int, seed: int) -> F32:
    """`count` targets whose halves are the mean of `samples` renders of one sample, (count, 1, 2, H, W, 3).

    Every render has a seed of its own.
    """
    seeds = range(seed, seed + 2 * count * samples)
    images = [scene.render_halves(view, seeds[i : i + AT_ONCE]) for i in range(0, len(seeds), AT_ONCE)]
    return np.concatenate(images).reshape(count, 1, 2, samples, SIZE, SIZE, 3).mean(axis=3)


def warm_up(network: Network, settings: TrainSettings, batch: TrainingBatch, noisy: Tensor) -> None:
    """Some steps of training, so that the layers that start at zero have left it."""
    optimiser = build_optimiser(network.parameters(), settings)
    for step in range(WARM_UP):
        optimiser.zero_grad()
        LOSSES["linear"](network(batch.inputs), noisy[step % len(noisy)]).backward()
        optimiser.step()


# ----------------------------------------------------------------------------------------------------------- statistics


@dataclass
class Gradients:
    """Mean gradient of each weight tensor over some targets, and the variance of that mean, summed over the tensor."""

    mean: list[Tensor]
    variance: Tensor  # (tensors,)


def gradients(rendered: Rendered, loss: Loss, targets: Tensor, clip: float | None = None) -> Gradients:
    """Gradients over `targets`, by the network and the loss as in training; each is clipped at the norm `clip`."""
    weights = list(rendered.network.parameters())
    image = rendered.network(rendered.batch.inputs)
    total = [torch.zeros_like(w, dtype=torch.float64) for w in weights]
    squares = torch.zeros(len(weights), dtype=torch.float64)
    for target in targets:
        found = torch.autograd.grad(loss(image, target), weights, retain_graph=True)
        norm = float(torch.stack([g.norm() for g in found]).norm())
        scale = 1.0 if clip is None else min(1.0, clip / norm)
        for place, gradient in enumerate(scale * g.double() for g in found):
            total[place] += gradient
            squares[place] += gradient.square().sum()
    n = len(targets)
    mean = [t / n for t in total]
    spread = squares / n - torch.stack([m.square().sum() for m in mean])
    return Gradients(mean, spread / (n - 1))


def deviations(noisy: Gradients, clean: Gradients) -> tuple[list[float], float]:
    """t of each weight tensor, and t of all of them as one vector."""
    apart = torch.stack([(a - b).square().sum() for a, b in zip(noisy.mean, clean.mean, strict=True)])
    variance = noisy.variance + clean.variance
    assert bool((variance > 0).all()), "every weight tensor has a gradient, and noise in it"
    return (apart / variance).sqrt().tolist(), float((apart.sum() / variance.sum()).sqrt())


# ---------------------------------------------------------------------------------------------------------------- tests


@pytest.mark.parametrize("name", sorted(LOSSES.keys() - {"paired"}))
def test_noisy_targets_give_the_gradient_of_the_clean_image_for_every_weight_tensor(rendered, name: str) -> None:
    """t ≤ 3 for each tensor and for all as one; a bias of a quarter of the gradient would show."""
    holds(rendered, LOSSES[name])


@pytest.mark.parametrize(
    ("architecture", "name", "passes"),
    [
        pytest.param("guided", "linear", 1, marks=pytest.mark.slow),
        pytest.param("guided_transport", "relative", 1, marks=pytest.mark.slow),
        pytest.param("guided_photons", "relative", 1, marks=pytest.mark.slow),
        ("guided_transport_photons", "relative", 1),
        pytest.param("guided_denoise", "relative", 1, marks=pytest.mark.slow),
        pytest.param("guided_denoise", "relative", 4, marks=pytest.mark.slow),
    ],
)
def test_so_they_do_for_networks_that_are_told_of_light(
    seen, architecture: Architecture, name: str, passes: int
) -> None:
    """Direct light, gloss, lit points, photons and a half are noisy, and have seen nothing of the targets' noise."""
    holds(of_architecture(seen, architecture, passes), LOSSES[name], shows=0.5)  # little is left to learn, and to pull


def holds(rendered: Rendered, loss: Loss, *, shows: float = 0.25) -> None:
    """t ≤ 3 for each tensor and for all as one; a bias of the share `shows` of the gradient would be seen."""
    noisy = gradients(rendered, loss, rendered.noisy)
    clean = gradients(rendered, loss, rendered.converged)
    each, together = deviations(noisy, clean)
    assert len(each) == sum(1 for _ in rendered.network.parameters()) > 40
    assert max(*each, together) <= 3
    length = math.sqrt(sum(float(g.square().sum()) for g in clean.mean))
    assert 3 * math.sqrt(float((noisy.variance + clean.variance).sum())) < shows * length


def test_weights_from_the_other_half_give_the_gradient_that_they_give_with_the_clean_image(rendered) -> None:
    """The weights with the clean image are from further noisy halves, as how noisy they are matters."""
    clean_image = rendered.converged.mean(dim=(0, 2)).expand(2, -1, -1, -1)[None]
    noisy, further = rendered.noisy[: K // 2], rendered.noisy[K // 2 :]
    wanted = gradients(rendered, lambda f, told: paired_loss(f, clean_image, told), further)
    each, together = deviations(gradients(rendered, paired_loss, noisy), wanted)
    assert max(*each, together) <= 3
    own = gradients(rendered, lambda f, t: paired_loss(f, t, t.flip(1)), noisy)  # each half weighted by itself
    each, together = deviations(own, wanted)
    assert together > 10
    assert min(each) > 3


def log1p(f: Tensor, t: Tensor) -> Tensor:
    return (torch.log1p(f.clamp(min=-0.9))[:, None] - torch.log1p(t)).square().mean()


def display(image: Tensor) -> Tensor:
    return image.clamp(1e-3, 1) ** (1 / 2.2)


BIASED: dict[str, Loss] = {
    "log1p": log1p,
    "clip and gamma": lambda f, t: (display(f)[:, None] - display(t)).square().mean(),
    "targets clamped": lambda f, t: (f[:, None] - t.clamp(max=1)).square().mean(),
    "L1": lambda f, t: (f[:, None] - t).abs().mean(),
    "relative, noisy weight": lambda f, t: ((f[:, None] - t).square() / (t.square() + 0.1)).mean(),
    "relative, weight not detached": lambda f, t: ((f[:, None] - t).square() / (f[:, None].square() + 0.1)).mean(),
}


@pytest.mark.parametrize("name", sorted(BIASED))
def test_a_biased_loss_misses_its_own_gradient_at_the_clean_image(rendered, name: str) -> None:
    noisy = gradients(rendered, BIASED[name], rendered.noisy[: K // 4])
    each, together = deviations(noisy, gradients(rendered, BIASED[name], rendered.converged))
    assert together > 10
    assert min(each) > 3


def test_clipped_gradients_miss_the_clean_gradient(rendered) -> None:
    """Clipped at the clean gradient's own norm, which would never touch it."""
    clean = gradients(rendered, LOSSES["linear"], rendered.converged)
    norm = math.sqrt(sum(float(g.square().sum()) for g in clean.mean))
    noisy = gradients(rendered, LOSSES["linear"], rendered.noisy, clip=norm)
    each, together = deviations(noisy, clean)
    assert together > 4.5
    assert np.mean(np.array(each) > 3) > 0.7
