"""Samples of a scene as tensors: one by one as a torch dataset, or in batches. Training reads by this too.

Shape letters: B batch, H W image, G movable groups, P points of the cloud, K photon slots.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields as dataclass_fields
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from photonfarm.core.errors import SpecError
from photonfarm.core.records import Guides, Photons
from photonfarm.scene.modification import columns
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import Camera, view_columns
from photonfarm.store.format.schema import output_arrays
from photonfarm.store.read.batch import Batch, Sample

GUIDES = tuple(field.name for field in dataclass_fields(Guides))

IMAGES = ("radiance", "albedo", "normal", "depth")
"""The images that every sample has."""

DEFAULT = (*IMAGES, *GUIDES, "modification", "view")
"""The fields that are taken unless some are named."""

OF_LIGHT = ("radiance", "emission", "direct", "gloss", "point_light")
"""The fields in units of radiance, or of irradiance, which are therefore exposed."""

POINTS = ("point_position", "point_present", "point_seen")

POINT_SURFACES = ("point_normal", "point_emission")
"""What configurations change of the points in scenes whose groups turn or emit otherwise."""

PHOTONS = tuple(f"photon_{field.name}" for field in dataclass_fields(Photons))

FLAGS = ("point_present", "point_seen", "photon_seen")
"""The fields of bool; all others are float32."""


class Samples(Protocol):
    """The samples of a scene by their rows: a `SceneReader`, or anything that behaves like it."""

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec."""

    @property
    def rows(self) -> NDArray[np.int64]:
        """The rows of the complete samples, ascending."""

    def read_samples(self, rows: Sequence[int], out: Batch) -> Sequence[Sample]:
        """The samples of complete rows, perhaps in the memory of `out`; StoreError if one cannot be read."""


class SampleTensors:
    """Samples as tensors, float32 unless they are flags: which there are, their memory, and how it is filled.

    By name, as `Sample` has them: `radiance` (2, H, W, 3), `albedo` (H, W, 3), `normal` (H, W, 3), `depth` (H, W), and
    the guides; `modification` (G, C), the translation of each group, 1 if it is present, and `modification.FURTHER`;
    `view` (6,), the camera's origin and target, and (7,) with a field of view where each has its own; `world_to_camera`
    (3, 4), and there `focal_px` (), the focal length in pixels; the points of the configuration,
    `point_position`, `point_normal`, `point_emission` (P, 3), `point_present` and `point_seen` (P,); and its photons,
    `photon_position` (K, 3) and so on to `photon_seen` (K,).
    """

    def __init__(
        self, spec: SceneSpec, fields: Sequence[str] = DEFAULT, *, exposure: float = 1.0, points: int | None = None
    ) -> None:
        """Take the names; light is multiplied by `exposure`, and of the scene's points there are the first `points`.

        All of `POINTS` come with `POINT_SURFACES` in a scene whose configurations change these, and `world_to_camera`
        with `focal_px` where each view has its own field of view.
        """
        surfaces = POINT_SURFACES if spec.further_changes and {*POINTS} <= {*fields} else ()
        lens = ("focal_px",) if spec.view.fov is not None and "world_to_camera" in fields else ()
        self._spec, self.fields, self._exposure = spec, tuple(dict.fromkeys([*fields, *surfaces, *lens])), exposure
        self._points = spec.points if points is None else min(points, spec.points)

    def empty(self, size: int, *, pinned: bool = False) -> dict[str, Tensor]:
        """Memory for `size` samples, (B, …) by name, to be used again and again; RuntimeError if there is none."""
        memory = {}
        for name in self.fields:
            kind = torch.bool if name in FLAGS else torch.float32
            memory[name] = torch.empty(size, *self._shape(name), dtype=kind, pin_memory=pinned)
        return memory

    def fill(self, memory: Mapping[str, Tensor], place: int, sample: Sample) -> None:
        """Write one sample into a place of such memory; stored types become float32 on the way, in one pass."""
        for name in self.fields:
            values = memory[name][place]
            values.copy_(torch.from_numpy(self._array(sample, name)))
            if name == "radiance":
                values.mul_(self._exposure * sample.scale)
            elif name in OF_LIGHT:
                values.mul_(self._exposure)

    def _array(self, sample: Sample, name: str) -> NDArray[Any]:
        if name == "radiance":
            return sample.radiance
        if name in ("modification", "view"):
            return np.ascontiguousarray(getattr(sample, name).vector, np.float32)
        if name == "world_to_camera":
            return Camera.of(sample.view, self._spec).world_to_camera
        if name == "focal_px":
            return np.array(Camera.of(sample.view, self._spec).focal_px)
        if name in (*POINTS, *POINT_SURFACES):
            points: NDArray[Any] = getattr(sample.point_cloud, name.removeprefix("point_"))
            return points[: self._points]
        if name == "photon_seen":
            return sample.seen_photons
        if name in PHOTONS:
            return np.asarray(getattr(sample.photons, name.removeprefix("photon_")))
        return sample.images[name]

    def _shape(self, name: str) -> tuple[int, ...]:
        points, photons = (self._points,), (self._spec.photons.slots,)
        shapes: dict[str, tuple[int, ...]] = {"view": (view_columns(self._spec),), "focal_px": ()}
        shapes["modification"] = len(self._spec.groups), columns(self._spec)
        shapes |= {"world_to_camera": (3, 4)} | dict.fromkeys(("point_position", *POINT_SURFACES), (*points, 3))
        shapes |= {"point_present": points, "point_seen": points, "photon_seen": photons, "photon_bounce": photons}
        shapes |= {name: (*photons, 3) for name in PHOTONS if name not in shapes}
        return shapes[name] if name in shapes else output_arrays(self._spec)[name].shape


class SceneDataset(Dataset[dict[str, Any]]):
    """A dictionary for each sample of a scene: `row`, `pass_number`, and tensors by name, as `SampleTensors` has them.

    References are further passes of few views; those of pass 0 have each view once.
    """

    def __init__(
        self, samples: Samples, fields: Sequence[str] | None = None, *, exposure: float = 1.0, points: int | None = None
    ) -> None:
        """All samples of a scene; use `Scene.torch`. Raises SpecError for a field that the samples do not have.

        Light is multiplied by `exposure`; of the scene's points there are the first `points`.
        """
        without = () if getattr(samples, "has_guides", True) else GUIDES
        exist = [
            name
            for name in (*DEFAULT, "world_to_camera", "focal_px", *POINTS, *POINT_SURFACES, *PHOTONS, "photon_seen")
            if name not in without
        ]
        chosen = tuple([name for name in DEFAULT if name in exist] if fields is None else fields)
        if unknown := [name for name in chosen if name not in exist]:
            raise SpecError(f"fields: {unknown[0]!r} is none of {', '.join(exist)}")
        self._samples = samples
        self.tensors = SampleTensors(samples.spec, chosen, exposure=exposure, points=points)
        self._stored: Batch | None = None

    @property
    def spec(self) -> SceneSpec:
        """The scene's spec."""
        return self._samples.spec

    def __len__(self) -> int:
        return len(self._samples.rows)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """The sample at a place; raises IndexError, and CorruptError if its bytes are not what was committed."""
        row = int(self._samples.rows[index])
        memory = self.tensors.empty(1)
        (sample,) = self._fill([row], memory)
        return {"row": row, "pass_number": sample.pass_number} | {name: values[0] for name, values in memory.items()}

    def read(self, rows: Sequence[int], out: dict[str, Tensor] | None = None) -> dict[str, Tensor]:
        """The samples in some rows of the store, (B, …) by name, in the first places of `out` or in new memory.

        One thread at a time may call it. Raises IncompleteError for a row that is not complete, CorruptError for bytes
        that are not what was committed.
        """
        memory = self.tensors.empty(len(rows)) if out is None else out
        self._fill(rows, memory)
        return {name: values[: len(rows)] for name, values in memory.items()}

    def _fill(self, rows: Sequence[int], memory: Mapping[str, Tensor]) -> Sequence[Sample]:
        """Write the samples in some rows into the first places of memory; returns them."""
        if self._stored is None or len(self._stored) < len(rows):
            guides = any(name in GUIDES for name in self.tensors.fields)
            self._stored = Batch.empty(self._samples.spec, len(rows), guides=guides)
        samples = self._samples.read_samples(rows, self._stored)
        for place, sample in enumerate(samples):
            self.tensors.fill(memory, place, sample)
        return samples
