"""A step of every network works on whole batches, and gives a card its work without waiting for it."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pytest
import torch
from read_batches import batch_of
from torch import Tensor
from torch.optim import optimizer
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.networks import ARCHITECTURES, inputs, network, predict_image, projection
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.runs.devices import Ranks
from photonfarm.trainer.runs.settings import make_preset
from photonfarm.trainer.training.learner import Learner, build_optimiser, group_weights

EVERY = sorted(ARCHITECTURES)

META = torch.device("meta")
"""A device with shapes and no values: whoever reads a number there fails, as whoever reads one of a card waits."""


@pytest.fixture
def as_on_a_card(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """What has a processor be treated as a card is from now on."""

    def switch() -> None:
        for module in (inputs, network, projection):
            monkeypatch.setattr(module, "is_asynchronous", lambda _: True)

    return switch


def learner_of(source: Any, architecture: str, **changes: Any) -> Learner:
    chosen = {"architecture": architecture, "width": 4, "points": 256, "lit_points": 128}
    settings = make_preset("small", network={**chosen, **changes}, device="cpu")
    return Learner(SceneFrame.of(source.spec, *source.base(), settings.network), settings, Ranks())


def batch_with_metal(source: Any, architecture: str, size: int) -> TrainingBatch:
    """Samples with a metal in two of the images, as many pixels as fill a tile in none."""
    batch = batch_of(source, range(size), ARCHITECTURES[architecture].needs)
    if (guides := batch.inputs.guides) is not None:
        for place in ((0, slice(2, 7), slice(1, 10)), (1, slice(5, 6), slice(3, 12))):
            guides.specular[place], guides.roughness[place] = 0.9, 0.3
    return batch


class Operators(TorchDispatchMode):
    """Counts the operators in the block, and those that are given tensors of two devices or make one of another."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: Counter[str] = Counter()
        self.copies: Counter[str] = Counter()

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        made = function(*args, **(kwargs or {}))
        self.calls[str(function)] += 1
        devices = {leaf.device for leaf in tree_leaves((args, kwargs, made)) if isinstance(leaf, Tensor)}
        self.copies[str(function)] += len(devices) > 1
        return made


@pytest.mark.parametrize("architecture", EVERY)
def test_a_step_has_as_many_operators_whatever_its_batch(make_source, architecture: str) -> None:
    source, found = make_source(8, photons=64), []
    for size in (2, 8):
        learner, batch = learner_of(source, architecture), batch_with_metal(source, architecture, size)
        learner.step(0, batch)
        with Operators() as operators:
            learner.step(1, batch)
        found.append(operators.calls)
    assert found[0] == found[1]
    assert found[0].total() > 100


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("architecture", EVERY)
def test_a_step_on_a_card_reads_nothing_and_is_handed_nothing(
    make_source, architecture: str, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optimizer, "_get_fused_kernels_supported_devices", lambda: ["cpu", "meta"])
    source = make_source(3, photons=64)
    learner = learner_of(source, architecture, precision=precision, filter_direct=precision == "bfloat16")
    batch = batch_with_metal(source, architecture, 3).to(META)
    assert learner.average is not None
    for each in (learner.network, learner.average.network):
        each.to(META)
    groups = group_weights(learner.network, learner._settings)
    learner._device, learner.optimiser = META, build_optimiser(groups, learner._settings)
    learner.step(0, batch)
    with Operators() as operators:
        loss = learner.step(1, batch)
    assert loss.device == META
    assert operators.calls.total() > 100
    assert not +operators.copies


@pytest.mark.parametrize("occlusion", ["exact", "window"])
@pytest.mark.parametrize("architecture", EVERY)
def test_a_card_gets_another_way_to_the_same_image_and_gradients(
    make_source, architecture: str, occlusion: str, as_on_a_card
) -> None:
    source = make_source(3, photons=64)
    learner = learner_of(source, architecture, occlusion=occlusion)
    found = []
    for change in (lambda: None, as_on_a_card):
        change()
        batch = batch_with_metal(source, architecture, 3).to(torch.device("cpu"))
        learner.network.zero_grad()
        image = predict_image(learner.network, batch.inputs)
        image.square().mean().backward()
        found.append([image.detach(), *(weight.grad.clone() for weight in learner.network.parameters())])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(other, one, rtol=1e-4, atol=1e-5 * float(one.abs().max()))
