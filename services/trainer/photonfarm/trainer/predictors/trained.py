"""Predictors: a training run after its training, and denoisers that need no training and get the same inputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from photonfarm.core.errors import SpecError, StoreError
from photonfarm.core.records import BasePointCloud, Geometry
from photonfarm.farm.training import ALONE, ONNX
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.networks import build, find_needs, name_misfit
from photonfarm.trainer.networks.inputs import Inputs, Needs, SceneFrame, require
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.predictors.denoisers import OIDN, Oidn, fill_in
from photonfarm.trainer.predictors.evaluation import DevicePredictor, make_network_predictor
from photonfarm.trainer.predictors.half_filter import HalfFilter, uses_denoiser
from photonfarm.trainer.predictors.network_file import PackedScene, note_training, read_network
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.devices import usable_device
from photonfarm.trainer.runs.run_folder import CHECKPOINT, read_settings, read_shares
from photonfarm.trainer.runs.settings import ReadyDenoiser, TrainSettings
from photonfarm.trainer.runs.user_code import is_own, name_in_errors


@dataclass(frozen=True, slots=True, eq=False)
class TrainedRun:
    """A run folder with a checkpoint, or a network on its own."""

    folder: Path  # or the file
    settings: TrainSettings
    scene_id: str
    exposure: float  # of the scene when the run began
    weights: dict[str, Any]  # that predict: averaged over its steps, if the run averages
    halves: int = 1  # of a network of halves: it is given the mean of so many
    packed: PackedScene | None = None  # of a network on its own
    trained: Mapping[str, Any] = field(default_factory=dict)  # how far and on what, as a checkpoint says

    @classmethod
    def load(cls, folder: Path, name: str = CHECKPOINT) -> Self:
        """The run with the weights of the checkpoint of this name, by default the last one; or a network on its own.

        Raises StoreError if the folder is not a run with a readable checkpoint, SpecError if its settings are not those
        of the checkpoint; and what `read_network` does.
        """
        if folder.is_file():
            settings, state, packed = read_network(folder)
            spec = packed.spec
            return cls(
                folder, settings, spec.scene_id, spec.exposure, state["network"], 1, packed, note_training(state)
            )
        if folder.suffix in (ALONE, ONNX) and not folder.exists():
            raise StoreError(f"{folder}: there is no such file; `photonfarm pack` writes one")
        settings, state = read_settings(folder), checkpoint.load(folder / name)
        identity = {"scene_id": state["scene_id"], "settings": settings.model_dump(mode="json")}
        checkpoint.check_continues(folder / name, state, identity)
        weights = average["weights"] if (average := state.get("average")) else state["network"]
        of_scene = str(state["scene_id"]), float(state["exposure"])
        return cls(folder, settings, *of_scene, weights, trained=note_training(state))

    @property
    def hold_out(self) -> float:
        """The share of its scene that neither it was trained on, nor the runs that its weights began with."""
        return min(self.settings.hold_out, read_shares(self.folder).get(self.scene_id, 1))

    def source(self, store: str | Path) -> SceneReader:
        """The samples of its scene in a store, exposed as they were when the run began."""
        return SceneReader(store, self.scene_id, exposure=self.exposure)

    def scene(self, store: str | Path) -> SceneReader | PackedScene:
        """What has the scene's `spec` and `base()`: a store, or the network's own file.

        Raises StoreError if there is no store, or it lacks the scene.
        """
        if self.packed is not None:
            return self.packed
        source = self.source(Store(store).root)
        _ = source.spec  # which says what is there instead
        return source

    def network(self, spec: SceneSpec, base: tuple[Geometry, BasePointCloud]) -> Network:
        """The trained network, on the CPU, for the scene that it was trained on."""
        settings = self.settings.network
        with name_in_errors(architecture=settings.architecture):
            network = build(settings, SceneFrame.of(spec, *base, settings), self.settings.seed)
        with name_misfit(self.folder, settings.architecture):
            network.load_state_dict(self.weights)
        return network

    @property
    def name(self) -> str:
        """The architecture, and the folder if its name adds something; of an absolute path its last part.

        With several halves it ends in such as " 8/1", as names of denoisers do.
        """
        architecture, folder = self.settings.network.architecture, self.folder
        name = folder.name if folder.is_absolute() else str(folder)
        return self.name_halves(architecture if name == architecture else f"{architecture} ({name})")

    def name_halves(self, name: str) -> str:
        """A name of the run, with the number of halves where there are several."""
        return name if self.halves == 1 else f"{name} {self.halves}/1"

    @property
    def needs(self) -> Needs:
        """The inputs of its network."""
        return replace(find_needs(self.settings.network), halves=self.halves)

    @property
    def sees_points(self) -> bool:
        """Whether its network reads which points a view sees; a class of the user's that has points may."""
        needs, network = self.needs, self.settings.network
        if is_own(network.architecture):
            return needs.points
        # those with guides sum over lit points, seen or not
        return needs.points and not needs.guides and network.occlusion == "exact"

    def predictor(self, spec: SceneSpec, base: tuple[Geometry, BasePointCloud], device: str) -> DevicePredictor:
        """The network as a predictor on a device. SpecError if the device is not usable."""
        predict = make_network_predictor(self.network(spec, base).to(usable_device(device)).eval())
        named = name_in_errors(architecture=self.settings.network.architecture)
        if not uses_denoiser(self.settings):
            return replace(predict, images=named(predict.images))
        filtered = HalfFilter(self.settings, predict.device)
        return replace(predict, images=lambda inputs: predict.images(filtered(inputs)))


ReadyChoice = tuple[ReadyDenoiser, int]
"""A ready denoiser; it is given one of so many pixels."""


@dataclass(frozen=True, slots=True)
class ReadyPredictor:
    """A denoiser that is given one of `kept` pixels of half A, or of the mean of A over several passes of the view."""

    denoiser: ReadyDenoiser
    kept: int
    settings: TrainSettings  # for reading samples
    halves: int = 1

    @property
    def name(self) -> str:
        """A name such as "oidn 1/4", or "oidn-fast 8/1": by the halves that a pixel is given."""
        return f"{self.denoiser} {self.halves}/{self.kept}"

    @property
    def needs(self) -> Needs:
        """The noisy colour, beside the buffers."""
        fed = self.denoiser.endswith("reflectance")
        return Needs(points=False, kept=self.kept, halves=self.halves, surface=fed)

    @property
    def sees_points(self) -> bool:
        """Whether it reads which points a view sees: it has none."""
        return False

    def predictor(self, _spec: object, _base: object, device: str) -> DevicePredictor:
        """The predictor on a device, whatever the scene. Raises what `Oidn` does, and SpecError for no such device."""
        place = usable_device(device)
        return DevicePredictor(self._images(place), place)

    def _images(self, device: torch.device) -> Callable[[Inputs], Tensor]:
        if self.denoiser == "none":
            return lambda inputs: require(inputs.noisy).colour
        if self.denoiser == "fill-in":
            return lambda inputs: fill_in(require(inputs.noisy), inputs.albedo)
        return Oidn(self.settings.threads, device, OIDN[self.denoiser])


def list_predictors(
    runs: Sequence[TrainedRun], denoisers: Sequence[ReadyChoice], halves: Sequence[int] = ()
) -> list[TrainedRun | ReadyPredictor]:
    """The runs, then ready denoisers, which read samples as the first run does.

    Networks of halves and denoisers are given the mean of so many `halves`, too. Raises SpecError where there are none.
    """
    several = [replace(run, halves=count) for run in runs if run.needs.passes for count in halves]
    if halves and not (several or denoisers):
        asked = ", ".join(map(str, halves))
        raise SpecError(
            f"halves = {asked}: no run is of a network of halves, as guided_denoise, and no denoiser is named"
        )
    amounts = [(*choice, 1) for choice in denoisers]
    amounts += [(name, 1, count) for name in dict.fromkeys(name for name, _ in denoisers) for count in halves]
    return [*runs, *several, *(ReadyPredictor(name, k, runs[0].settings, count) for name, k, count in amounts)]
