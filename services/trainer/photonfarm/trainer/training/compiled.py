"""Networks whose kernels torch compiles."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import nn

from photonfarm.shared.core.errors import SpecError
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.runs.settings import Compilation

MODES = {"on": "default", "graphs": "reduce-overhead"}
"""torch's name of each way to compile; the second records CUDA graphs."""


def compile_network(network: nn.Module, how: Compilation, device: torch.device) -> None:
    """Have torch compile a network's U-Net when it is first used; all of a network that is no `Network`.

    The U-Net is most of the work, and its shapes are those of the image; how many points land in an image differs by
    the view, and would be compiled again and again. Weights keep their names; values change by rounding alone. Raises
    SpecError for CUDA graphs on another device.
    """
    if how == "off":
        return
    if how == "graphs" and device.type != "cuda":
        raise SpecError(f"compile = 'graphs': CUDA graphs need a CUDA device, and this run is on {device}; give on")
    (network.image_synthesis if isinstance(network, Network) else network).compile(mode=MODES[how], dynamic=False)


@contextmanager
def compiling(how: Compilation) -> Iterator[None]:
    """Turn a failure to compile into a SpecError of one sentence."""
    try:
        yield
    except Exception as error:
        if how == "off" or not isinstance(error, _compilers_errors()):
            raise
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise SpecError(
            f"compile = {how!r}: torch cannot compile the network on this machine: {reason}. It needs a C++ compiler, "
            "and on CUDA Triton; install these, or train with compile = off"
        ) from error


def _compilers_errors() -> tuple[type[Exception], ...]:
    """The errors of torch's compiler, which is imported here only where it has been used."""
    from torch._dynamo.exc import TorchDynamoException

    return (TorchDynamoException,)
