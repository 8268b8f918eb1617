"""A trained network as ONNX, for programs without torch: its inputs by name, and the image.

Inputs are called as a torch dataset calls them, and those of a noisy half `noisy_…`; light among them, and the image,
are × exposure. The batch may have any size; height and width are those of the scene's film, as the camera's rays are
constants of a network.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from photonfarm.core.errors import SpecError, StoreError, say_install, store_errors
from photonfarm.core.files import whole_file
from photonfarm.data.torch_dataset import SampleTensors
from photonfarm.scene.spec import SceneSpec
from photonfarm.trainer.networks.inputs import Inputs, NoisyColour
from photonfarm.trainer.networks.network import ImageSynthesisLayer
from photonfarm.trainer.predictors.half_filter import uses_denoiser
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs.user_code import is_own

NOISY = "noisy_"
IMAGE = "radiance"


class NamedNetwork(nn.Module):
    """A network of tensors by name: `forward` takes them in the order of the names."""

    def __init__(self, network: nn.Module, names: Sequence[str]) -> None:
        super().__init__()
        self.network, self.names = network, tuple(names)

    def forward(self, *tensors: Tensor) -> Tensor:
        """The image, (B, H, W, 3), linear radiance × exposure."""
        named = dict(zip(self.names, tensors, strict=True))
        noisy = {name.removeprefix(NOISY): named[name] for name in self.names if name.startswith(NOISY)}
        image: Tensor = self.network(Inputs.of(named, NoisyColour(**noisy) if noisy else None))
        return image


def list_inputs(run: TrainedRun, spec: SceneSpec, size: int) -> dict[str, Tensor]:
    """Memory for the inputs of a run's network, by name, for a batch of so many."""
    needs = run.needs
    fields = [name for name in needs.fields if name != "radiance"]
    named = SampleTensors(spec, fields, points=run.settings.network.points).empty(size)
    if needs.kept:
        named[f"{NOISY}colour"] = torch.empty_like(named["albedo"])
        named[f"{NOISY}kept"] = torch.empty_like(named["depth"], dtype=torch.bool)
    if needs.passes:
        named[f"{NOISY}passes"], named[f"{NOISY}variance"] = torch.empty(size), torch.empty_like(named["depth"])
    if uses_denoiser(run.settings):
        named[f"{NOISY}filtered"] = torch.empty_like(named["albedo"])
    return named


def write_onnx(run: TrainedRun, store: str | Path, file: Path) -> None:
    """Write a run's network as ONNX; its metadata say scene, architecture and exposure.

    A network of bfloat16 or TF32 computes in float32 there. Raises StoreError without the packages and for a store
    without the scene, SpecError for a network of the user's own that cannot be exported.
    """
    if find_spec("onnxscript") is None:
        raise StoreError(f"{file}: needs the packages onnx and onnxscript; {say_install('onnx')}")
    source = run.scene(store)
    inputs = list_inputs(run, source.spec, 2)
    network = run.network(source.spec, source.base()).eval()
    for module in network.modules():
        if isinstance(module, ImageSynthesisLayer):
            module.precision = "float32"
    architecture = run.settings.network.architecture
    about = {"scene": source.spec.scene_id, "name": source.spec.name, "architecture": architecture}
    try:
        exported = _export(NamedNetwork(network, list(inputs)), inputs)
    except Exception as error:
        if not is_own(architecture):
            raise
        raise SpecError(f"architecture = {architecture!r}: torch cannot export it: {error}") from error
    exported.model.metadata_props["photonfarm"] = json.dumps({**about, "exposure": run.exposure})
    with store_errors("write the network", file), whole_file(file) as part:
        exported.save(part)


def _export(network: NamedNetwork, inputs: dict[str, Tensor]) -> Any:
    from onnxscript import optimizer

    batch = torch.export.Dim("batch", min=1)
    for name in ("torch.onnx", "onnx_ir"):  # which warn of what the user has no part in
        logging.getLogger(name).setLevel(logging.ERROR)
    with torch.no_grad(), warnings.catch_warnings(action="ignore"):  # torch's, of its own code
        shapes = {"tensors": tuple({0: batch} for _ in inputs)}
        program = torch.export.export(network, tuple(inputs.values()), dynamic_shapes=shapes, strict=True)
        exported = torch.onnx.export(
            program,
            input_names=list(inputs),
            output_names=[IMAGE],
            dynamic_shapes={"tensors": tuple({0: "batch"} for _ in inputs)},
            custom_translation_table=_translations(),
            optimize=False,  # with what it does by itself, guided_denoise takes minutes
            verbose=False,
            dynamo=True,
        )
        assert exported is not None  # noqa: S101 - it is with dynamo
        for node in exported.model.graph.all_nodes():
            node.metadata_props.clear()  # traces, with the names of this machine's folders
        optimizer.optimize(exported.model, num_iterations=1, onnx_shape_inference=False)
    return exported


def _translations() -> dict[Any, Any]:
    """Operators that torch knows no ONNX for, as networks use them, each as a function of onnxscript."""
    from onnxscript import INT64, opset18

    op: Any = opset18  # whose types are those of tensors, not of what stands for them here

    def find_nonzero(values: Any, size: Any, fill_value: int = -1) -> Any:  # noqa: ARG001 - there are as many
        return op.Transpose(op.NonZero(values), perm=[1, 0])

    def repeat_places(repeats: Any, output_size: Any = None) -> Any:  # noqa: ARG001 - their sum
        zero, one = op.Constant(value_int=0), op.Constant(value_int=1)
        first, second = op.Constant(value_ints=[0]), op.Constant(value_ints=[1])
        places = op.Range(zero, op.ReduceSum(repeats, keepdims=0), one)
        past = op.GreaterOrEqual(op.Unsqueeze(places, second), op.Unsqueeze(op.CumSum(repeats, zero), first))
        return op.ReduceSum(op.Cast(past, to=int(INT64.dtype)), second, keepdims=0)

    aten = torch.ops.aten
    return {aten.nonzero_static.default: find_nonzero, aten.repeat_interleave.Tensor: repeat_places}
