"""The settings that a run was made with, read back from its folder."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import ValidationError

from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.scene.spec import sentences
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import SETTINGS
from photonfarm.trainer.runs.settings import KEYS, TrainSettings


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
