"""Samples of a scene as a torch dataset.

Shape letters: H W image, G movable groups.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields as dataclass_fields
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.utils.data import Dataset

from photonfarm.data.sample import IMAGES
from photonfarm.shared.core.errors import SpecError
from photonfarm.shared.core.records import Guides

if TYPE_CHECKING:
    from photonfarm.data.sample import Sample
    from photonfarm.data.scene import Scene


class SceneDataset(Dataset[dict[str, Any]]):
    """A dictionary for each sample: its `row`, and float32 tensors by name.

    `radiance` (2, H, W, 3), `albedo` (H, W, 3), `normal` (H, W, 3) and `depth` (H, W) as `Sample` has them; guides
    likewise; `modification` (G, 4), the translation of each group and 1 if it is present; and `view` (6,), the camera's
    origin and target.
    """

    def __init__(self, scene: Scene, fields: Sequence[str] | None = None) -> None:
        """All samples of a scene; use `Scene.torch`. Raises SpecError for a field that the samples do not have."""
        guides = [field.name for field in dataclass_fields(Guides)] if scene.has_guides else []
        exist = (*IMAGES, *guides, "modification", "view")
        self._scene, self._fields = scene, tuple(exist if fields is None else fields)
        if unknown := [name for name in self._fields if name not in exist]:
            raise SpecError(f"fields: {unknown[0]!r} is none of {', '.join(exist)}")

    def __len__(self) -> int:
        return len(self._scene)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """The sample at a place; raises IndexError, and CorruptError if its bytes are not what was committed."""
        sample = self._scene[index]
        return {"row": sample.row} | {name: torch.from_numpy(_array(sample, name)) for name in self._fields}


def _array(sample: Sample, name: str) -> np.ndarray[Any, np.dtype[np.float32]]:
    if name in ("modification", "view"):
        return np.ascontiguousarray(getattr(sample, name).vector, np.float32)
    return np.ascontiguousarray(getattr(sample, name), np.float32)
