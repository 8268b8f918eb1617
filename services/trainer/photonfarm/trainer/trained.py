"""A training run as those see it who come after the training: its settings, its scene, its network."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pydantic import ValidationError

from photonfarm.shared.errors import SpecError
from photonfarm.shared.records import BasePointCloud, Geometry
from photonfarm.shared.scene import SceneSpec, sentences
from photonfarm.trainer import checkpoint
from photonfarm.trainer.device import usable_device
from photonfarm.trainer.evaluation import DevicePredictor, network_predictor
from photonfarm.trainer.loop import CHECKPOINT, SETTINGS
from photonfarm.trainer.networks import ARCHITECTURES, build
from photonfarm.trainer.networks.frame import SceneFrame
from photonfarm.trainer.networks.inputs import Needs
from photonfarm.trainer.networks.network import Network
from photonfarm.trainer.settings import KEYS, TrainSettings


@dataclass(frozen=True, slots=True, eq=False)
class TrainedRun:
    """A run folder with a checkpoint."""

    folder: Path
    settings: TrainSettings
    scene_id: str
    weights: dict[str, Any]  # by which it predicts: averaged over its steps, where it was trained so

    @classmethod
    def load(cls, folder: Path, name: str = CHECKPOINT) -> Self:
        """The run with the weights of the checkpoint of this name, the last one that was written unless told otherwise.

        Raises SpecError if the folder is not a run, or its settings are not those of the checkpoint; StoreError without
        a readable checkpoint.
        """
        settings, state = read_settings(folder), checkpoint.load(folder / name)
        said = {"scene_id": state["scene_id"], "settings": settings.model_dump(mode="json")}
        checkpoint.check_continues(folder / name, state, said)
        weights = average["weights"] if (average := state.get("average")) else state["network"]
        return cls(folder, settings, str(state["scene_id"]), weights)

    def network(self, spec: SceneSpec, base: tuple[Geometry, BasePointCloud]) -> Network:
        """The trained network, on the CPU, for the scene that it was trained on."""
        settings = self.settings.network
        network = build(settings, SceneFrame.of(spec, *base, settings), self.settings.seed)
        network.load_state_dict(self.weights)
        return network

    @property
    def name(self) -> str:
        """Architecture, and the folder where that says more; of an absolute path its last part."""
        architecture, folder = self.settings.network.architecture, self.folder
        said = folder.name if folder.is_absolute() else str(folder)
        return architecture if said == architecture else f"{architecture} ({said})"

    @property
    def needs(self) -> Needs:
        """What its network reads."""
        return ARCHITECTURES[self.settings.network.architecture].needs

    def predictor(self, spec: SceneSpec, base: tuple[Geometry, BasePointCloud], device: str) -> DevicePredictor:
        """The network's images, made on a device. SpecError where that is not usable."""
        return network_predictor(self.network(spec, base).to(usable_device(device)).eval())


def read_settings(run: Path) -> TrainSettings:
    """The settings a run was made with. Raises SpecError if there is no run."""
    path = run / SETTINGS
    try:
        document = json.loads(path.read_text())
        settings = TrainSettings.model_validate(document)
    except FileNotFoundError as error:
        if not run.is_dir():
            raise SpecError(f"{run}: there is no such folder") from error
        raise SpecError(
            f"{run}: is not a training run, or one that still waits for samples: it holds no {SETTINGS}"
        ) from error
    except OSError as error:
        raise SpecError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise SpecError(f"{path}: {'; '.join(sentences(error, KEYS))}") from error
    except ValueError as error:
        raise SpecError(f"{path}: is not the JSON that a training run leaves there: {error}") from error
    checkpoint.check_of_this_version(path, document.get("network", {}))
    return settings
