"""One sample, and a batch of samples in memory that is reused, without a copy or conversion.

Shape letters: B batch, H W image, G movable groups, P points of the cloud, K photon slots.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.keys import Key, seed_of
from photonfarm.core.records import F32, BasePointCloud, Guides, Photons, ViewBuffers, Visibility, arrays_of
from photonfarm.scene.modification import Modification, rebuild, rebuild_surfaces
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.view import View
from photonfarm.store.format import schema

GUIDE_NAMES = frozenset(field.name for field in fields(Guides))

Images = TypeVar("Images", ViewBuffers, Guides)


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """The P points of a scene in the configuration of one sample: the scene's own points, moved with their groups.

    position: (P, 3) float32, world coordinates in scene units.
    normal: (P, 3) float32, geometric unit normals in world coordinates.
    albedo: (P, 3) float32, diffuse reflectance.
    emission: (P, 3) float32, radiance that leaves along the normal, linear RGB.
    present: (P,) bool, False for points of removed groups.
    seen: (P,) bool, whether the view sees the point: it is in the image, and nothing hides it.
    """

    position: F32
    normal: F32
    albedo: F32
    emission: F32
    present: NDArray[np.bool_]
    seen: NDArray[np.bool_]


def _not_given() -> NoReturn:
    raise ValueError("this sample was made without its scene's points and photons")


@dataclass(frozen=True, eq=False)
class Sample:
    """One complete sample. The point cloud and photons are read when they are asked for.

    Images are rows from top to bottom, and linear; nothing is clipped. As `SceneReader.read` and `photonfarm.data` give
    a sample, its images are float32, its `scale` is 1, and its memory is its own. Those of `SceneReader.read_samples`
    are in the store's types, in memory that the next read reuses.
    """

    row: int  # in the store, which never changes
    key: Key  # the content key: 16 bytes, a hash of scene, modification, view and pass
    modification: Modification  # the configuration: `translation` (G, 3) from rest, scene units, `present` (G,), …
    view: View  # the camera's origin and target, world coordinates in scene units
    pass_number: int  # of the noisy pass, from 0: passes of one view differ in their noise alone
    radiance: NDArray[Any]  # (2, H, W, 3) independent noisy estimates A and B of one image, times `scale` linear RGB
    buffers: ViewBuffers
    visibility: Visibility
    guides: Guides | None = None  # images that networks may be given; None: not asked for
    scale: float = 1.0  # a power of two
    read_cloud: Callable[[], BasePointCloud] = field(default=_not_given, repr=False)
    read_photons: Callable[[], Photons] = field(default=_not_given, repr=False)

    def __repr__(self) -> str:
        return f"<sample {self.row}, pass {self.pass_number}>"

    def __getattr__(self, name: str) -> Any:
        """A buffer or a guide by its name, such as `albedo` or `direct`; AttributeError with the names that exist."""
        images = {} if name.startswith("_") else self.images
        if name in images:
            return images[name]
        exist = ", ".join(sorted([*(each for each in dir(self) if not each.startswith("_")), *images]))
        raise AttributeError(f"a sample has no {name!r}; it has {exist}", name=name, obj=self)

    @property
    def images(self) -> dict[str, NDArray[Any]]:
        """What is known of the view, by name: albedo, normal and depth, and the guides if there are any."""
        return arrays_of(self.buffers) | ({} if self.guides is None else arrays_of(self.guides))

    @property
    def seeds(self) -> tuple[int, int]:
        """The seeds of the halves A and B, 32 bits each, functions of the key.

        A render that was not finite has been drawn again with another seed; the job's marker counts these.
        """
        return seed_of(self.key, "half A"), seed_of(self.key, "half B")

    @cached_property
    def point_cloud(self) -> PointCloud:
        """The scene's points as this configuration has them, and which of them the view sees."""
        base = self.read_cloud()
        position, present = rebuild(base, self.modification)
        normal, emission = rebuild_surfaces(base, self.modification)
        return PointCloud(position, normal, base.albedo, emission, present, self.visibility.points)

    @cached_property
    def photons(self) -> Photons:
        """The photons of this configuration, K slots; StoreError for a scene without photons."""
        return self.read_photons()

    @property
    def seen_photons(self) -> NDArray[np.bool_]:
        """Whether the view sees each photon, (K,); (0,) for a scene without photons."""
        return self.visibility.photons

    def decoded(self) -> Sample:
        """The same in float32, unscaled, in memory of its own."""
        radiance = self.radiance.astype(np.float32) * np.float32(self.scale)
        guides = None if self.guides is None else _decoded(self.guides)
        return replace(self, radiance=radiance, scale=1.0, buffers=_decoded(self.buffers), guides=guides)


def _decoded(record: Images) -> Images:
    return type(record)(**{name: values.astype(np.float32) for name, values in arrays_of(record).items()})


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Samples in their stored types; `SceneReader.read_batch` fills it."""

    spec: SceneSpec
    radiance: NDArray[np.float16]  # (B, 2, H, W, 3) linear × 1/`scale`, halves A and B; NaN if it is in `wide`
    of_view: dict[str, NDArray[Any]]  # (B, …) by name: buffers and bits of what is seen, and guides; or none of these
    rows: NDArray[np.int64]  # (B,) row of each sample, of its view and of its modification
    view_rows: NDArray[np.int64]
    modification_rows: NDArray[np.int64]
    wide: dict[int, F32] = field(default_factory=dict)  # by place: (2, H, W, 3) unscaled, where float16 cannot hold it

    @classmethod
    def empty(cls, spec: SceneSpec, size: int, *, buffers: bool = True, guides: bool = False) -> Batch:
        """Memory for `size` samples of a scene; without memory for buffers, neither they nor visibility are read."""
        arrays = schema.output_arrays(spec)
        of_view = [name for name, array in arrays.items() if array.kind == "view"]
        names = [name for name in of_view if (guides if name in GUIDE_NAMES else buffers)]
        memory = {name: np.empty((size, *arrays[name].shape), arrays[name].dtype) for name in ("radiance", *names)}
        rows, view_rows, modification_rows = np.zeros((3, size), np.int64)
        return cls(spec, memory.pop("radiance"), memory, rows, view_rows, modification_rows)

    def __len__(self) -> int:
        """The number of samples that it holds, or has memory for."""
        return len(self.rows)

    def first(self, count: int) -> Batch:
        """The first samples, in the same memory."""
        own = ("radiance", "rows", "view_rows", "modification_rows")
        of_view = {name: values[:count] for name, values in self.of_view.items()}
        return replace(self, of_view=of_view, **{name: getattr(self, name)[:count] for name in own})

    def linear(self, place: int) -> F32:
        """The radiance of one sample as it was rendered, (2, H, W, 3) linear, unscaled."""
        if place in self.wide:
            return self.wide[place]
        return self.radiance[place].astype(np.float32) * np.float32(self.scale)

    @property
    def scale(self) -> float:
        """The factor from `radiance` to linear radiance, a power of two."""
        return float(2.0**-self.spec.radiance_exponent)

    def buffers(self, place: int) -> ViewBuffers:
        """The buffers of one sample's view, in the same memory."""
        return ViewBuffers(**{each.name: self.of_view[each.name][place] for each in fields(ViewBuffers)})

    def guides(self, place: int) -> Guides | None:
        """The guides of one sample's view, in the same memory; None if they were not asked for."""
        known = {name: values[place] for name, values in self.of_view.items() if name in GUIDE_NAMES}
        return Guides(**known) if known else None

    def visibility(self, place: int) -> Visibility:
        """Which points and photons the view of one sample sees, unpacked into new memory."""
        seen = {
            name: np.unpackbits(self.of_view[name][place], count=count, bitorder="little").view(np.bool_)
            if count
            else np.zeros(0, np.bool_)
            for name, count in schema.bit_counts(self.spec).items()
        }
        return Visibility(points=seen["point_seen"], photons=seen["photon_seen"])
