"""The device of a network, and its arithmetic there."""

from __future__ import annotations

import re

import torch

from photonfarm.core.errors import SpecError
from photonfarm.trainer.runs.settings import Precision

AUTO = "auto"


def usable_device(name: str) -> torch.device:
    """The device of this name, "cpu", "cuda" or "cuda:N"; for "auto", cuda if there is one and otherwise the cpu.

    On CUDA float32 then means float32 in this process: by torch's default convolutions round their factors to TF32,
    whose mantissa has 10 bits. That is done where a network is asked for it, by `round_convolutions`. Raises SpecError
    if torch cannot use the device.
    """
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", name):
        raise SpecError(f"device = {name!r}: must be auto, cpu, cuda or cuda:N")
    try:
        device = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if name == AUTO else name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:  # the latter if torch was built without CUDA
        raise SpecError(f"device = {name!r}: cannot be used here: {str(error).splitlines()[0]}") from error
    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = False
    return device


def round_convolutions(device: torch.device, precision: Precision) -> None:
    """Let convolutions on CUDA round their factors to TF32 from now on, or not; their sums are float32 either way.

    The setting is the process's, and a gradient's convolutions heed it too. So a network sets it before each image.
    """
    if device.type == "cuda":
        torch.backends.cudnn.allow_tf32 = precision == "tf32"


def described(device: torch.device, precision: Precision = "float32") -> str:
    """The device in words: "cpu", or "cuda (NVIDIA H200)"; with a warning if it is slow at this precision."""
    if device.type == "cuda":
        return f"{device} ({torch.cuda.get_device_name(device)})"
    if precision == "tf32":
        return f"{device}, which has no TF32, and computes in float32 instead"
    if precision == "bfloat16" and not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return f"{device}, which has no instructions for bfloat16: precision = float32 is several times faster here"
    return str(device)
