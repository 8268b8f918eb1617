"""Views that are not in a store, such as those of a camera path, as one file: buffers, and which points they see.

The renderer writes it, and the trainer reads it. Shape letters: F frames, G movable groups, H W image, P points, K
photon slots.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from photonfarm.shared.core.archives import stored_arrays, write_arrays
from photonfarm.shared.core.records import F32, Guides, Photons, ViewBuffers, Visibility, arrays_of
from photonfarm.shared.scene.modification import Modification
from photonfarm.shared.scene.view import View

_OF_VIEWS = ("depth", "albedo", "normal", "point_seen", "photon_seen")


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Views of one configuration of a scene, without radiance."""

    scene_id: str
    modification: Modification
    views: tuple[View, ...]
    depth: F32  # (F, H, W) and so on, as in `ViewBuffers`
    albedo: F32  # (F, H, W, 3)
    normal: F32  # (F, H, W, 3)
    point_seen: NDArray[np.bool_]  # (F, P) and (F, K), as in `Visibility`
    photon_seen: NDArray[np.bool_]  # (F, K)
    photons: Photons | None  # of the configuration; None for a scene without
    guides: Guides  # (F, …) of all views

    def __len__(self) -> int:
        """How many frames there are."""
        return len(self.views)

    def buffers(self, frame: int) -> ViewBuffers:
        """The buffers of one frame."""
        return ViewBuffers(self.depth[frame], self.albedo[frame], self.normal[frame])

    def visibility(self, frame: int) -> Visibility:
        """Which points and photons one frame sees."""
        return Visibility(self.point_seen[frame], self.photon_seen[frame])

    def guides_of(self, frame: int) -> Guides:
        """The guides of one frame."""
        return Guides(**{name: values[frame] for name, values in arrays_of(self.guides).items()})

    def write(self, file: Path) -> None:
        """Store them as a NumPy archive, whole or not at all; raises StoreError if the disk refuses."""
        arrays: dict[str, NDArray[Any]] = {
            "scene_id": np.array(self.scene_id),
            "modification": self.modification.vector,
            "view": np.stack([view.vector for view in self.views]),
            **{name: getattr(self, name) for name in _OF_VIEWS},
            **{f"guide_{name}": array for name, array in arrays_of(self.guides).items()},
        }
        if self.photons is not None:
            arrays |= {f"photon_{name}": array for name, array in arrays_of(self.photons).items()}
        write_arrays(file, arrays, "buffers")

    @classmethod
    def read(cls, file: Path) -> Self:
        """Read what `write` stored; raises StoreError for anything else."""
        with stored_arrays(file, "buffers", "buffers") as stored:
            views = tuple(View.from_vector(vector) for vector in stored["view"])
            photons = None
            if "photon_bounce" in stored:
                photons = Photons(*(stored[f"photon_{field.name}"] for field in fields(Photons)))
            guides = Guides(*(stored[f"guide_{field.name}"] for field in fields(Guides)))
            modification = Modification.from_vector(stored["modification"])
            of_views = {name: stored[name] for name in _OF_VIEWS}
            return cls(str(stored["scene_id"]), modification, views, photons=photons, guides=guides, **of_views)
