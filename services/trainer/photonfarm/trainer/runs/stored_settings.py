"""The settings that a run was made with, read back from its folder."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import ValidationError

from photonfarm.shared.core.errors import StoreError
from photonfarm.shared.core.models import sentences
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import SETTINGS
from photonfarm.trainer.runs.settings import KEYS, TrainSettings


def read_settings(run: Path) -> TrainSettings:
    """The settings a run was made with.

    Raises StoreError if there is no run or its settings cannot be read, SpecError for those of another version.
    """
    path = run / SETTINGS
    try:
        document = json.loads(path.read_text())
        settings = TrainSettings.model_validate(document)
    except FileNotFoundError as error:
        if not run.is_dir():
            raise StoreError(f"{run}: there is no such folder") from error
        raise StoreError(
            f"{run}: is not a training run, or one that still waits for samples: it holds no {SETTINGS}"
        ) from error
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise StoreError(f"{path}: {'; '.join(sentences(error, KEYS))}") from error
    except ValueError as error:
        raise StoreError(f"{path}: is not the JSON that a training run leaves there: {error}") from error
    checkpoint.check_of_this_version(path, document.get("network", {}))
    return settings
