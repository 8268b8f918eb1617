"""What a network is given: the constants of its scene when it is built, and the inputs of each batch of samples.

Of the inputs, camera and buffers are always there, others only if the network needs them.

Shape letters: B batch, P points, L of them that are lit, K photon slots, H W image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from photonfarm.core.records import F32, BasePointCloud, Geometry
from photonfarm.data.torch_dataset import GUIDES, IMAGES, PHOTONS, POINT_SURFACES, POINTS
from photonfarm.scene.poor_views import hand_of
from photonfarm.scene.spec import SceneSpec
from photonfarm.trainer.networks.projection import Optics
from photonfarm.trainer.runs.devices import is_asynchronous
from photonfarm.trainer.runs.settings import NetworkSettings

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True, slots=True, eq=False)
class SceneFrame:
    """The constants of a scene by which inputs are normalised to values near 1; all ours, as the supplement gives none.

    Positions are taken about the centre of the geometry's bounding box and, like depths, divided by half its diagonal.
    Emission is divided by its root mean square over the cloud: lamps, few points among many, stand out so far that the
    maxima over points, by which networks pool, encode the lamps' places even before training. With `emission = log`
    that is done once more with log(1 + emission): lamps and far brighter windows then stand out alike. Normals, rays
    and albedo are near 1 anyway.
    """

    optics: Optics
    centre: F32  # (3,)
    scale: float  # half the diagonal, scene units
    base: F32  # (P, 3) where each point is in the base configuration, world, scene units
    appearance: F32  # (P, 9) the constants of each point: normal, albedo, emission
    photon_paths: int  # light paths emitted in each configuration; 0: the scene has no photons
    exposure: float  # the spec's factor on radiance
    max_depth: int  # edges of a path of the images; −1: no limit
    area: float  # of all surfaces, scene units²
    hand: float = 0.0  # within which a view is near (`poor_views.hand_of`), scene units
    changes: bool = False  # whether configurations change normals and emission of points
    emission_scales: tuple[float, ...] = (1.0,)  # by which emission is divided, and then log(1 + emission) if there is

    @classmethod
    def of(cls, spec: SceneSpec, geometry: Geometry, cloud: BasePointCloud, settings: NetworkSettings) -> SceneFrame:
        """The frame of a scene, for the first `settings.points` points of its cloud (uniform draws, as all are)."""
        low, high = geometry.vertices.min(axis=0), geometry.vertices.max(axis=0)
        used = slice(settings.points)
        emission, scales = cloud.emission[used], []
        for step in range(1 + (settings.emission == "log")):
            emission = np.log1p(emission) if step else emission
            scales.append(max(float(np.sqrt(np.mean(emission**2))), 1e-30))
            emission = np.asarray(emission / scales[-1], np.float32)
        appearance = np.concatenate([cloud.normal[used], cloud.albedo[used], emission], axis=1)
        scale = max(0.5 * float(np.linalg.norm(high - low)), 1e-30)
        return cls(
            optics=Optics.of(spec, settings.occlusion, settings.occlusion_tolerance),
            centre=(0.5 * (low + high)).astype(np.float32),
            scale=scale,
            base=cloud.position[used].astype(np.float32),
            appearance=appearance.astype(np.float32),
            photon_paths=spec.photons.paths,
            exposure=spec.exposure,
            max_depth=spec.transport.max_depth,
            area=float(geometry.areas().sum()),
            hand=hand_of(spec),
            changes=spec.further_changes,
            emission_scales=tuple(scales),
        )

    def normalise_emission(self, emission: Tensor) -> Tensor:
        """Emission of points in any configuration as `appearance` has that of the base."""
        first, *further = self.emission_scales
        emission = emission / first
        return torch.log1p(emission) / further[0] if further else emission


M = TypeVar("M")
T = TypeVar("T", bound="DataclassInstance")


@dataclass(frozen=True, slots=True)
class Needs:
    """The inputs that a predictor, trained or not, reads beside camera and buffers."""

    points: bool = True
    photons: bool = False
    guides: bool = False
    kept: int | None = None  # one of so many pixels of half A is an input, in noisy colour; None: no colour
    passes: bool = False  # with `kept`: half A is the mean over passes, where a view has several, and is filtered
    halves: int = 1  # of which noisy colour is the mean: the halves A of so many passes of the view
    surface: bool = False  # the guides that take no shadow ray

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields of a `SceneDataset` that training needs: those of these inputs, and the radiance as target."""
        points = POINTS if self.points else ()
        photons = (*PHOTONS, "photon_seen") if self.photons else ()
        guides = GUIDES if self.guides else SURFACE if self.surface else ()
        return (*IMAGES, "world_to_camera", *points, *photons, *guides)


@dataclass(frozen=True, slots=True, eq=False)
class PointInputs:
    """The point cloud of each sample's configuration."""

    position: Tensor  # (B, P, 3) world, scene units
    present: Tensor  # (B, P) bool; False: of a removed group
    seen: Tensor  # (B, P) bool; in this view, as rendered
    normal: Tensor | None = None  # (B, P, 3) where configurations change it, or emission
    emission: Tensor | None = None  # (B, P, 3) radiance leaving along the normal


@dataclass(frozen=True, slots=True, eq=False)
class PhotonInputs:
    """The photons of each sample's configuration, in the store's fixed number of slots."""

    position: Tensor  # (B, K, 3) world, scene units
    direction: Tensor  # (B, K, 3) unit, the way the light travels
    normal: Tensor  # (B, K, 3) unit
    power: Tensor  # (B, K, 3) flux over the number of paths emitted, as stored
    bounce: Tensor  # (B, K) float: surfaces met before; −1: an empty slot
    present: Tensor  # (B, K) bool; False: an empty slot
    seen: Tensor  # (B, K) bool; in this view, as rendered


@dataclass(frozen=True, slots=True, eq=False)
class NoisyColour:
    """The kept pixels of one half-estimate, and what follows from it alone."""

    colour: Tensor  # (B, H, W, 3) linear radiance × exposure, zero where not kept
    kept: Tensor  # (B, H, W) bool
    passes: Tensor | None = None  # (B,) float: it is the mean of so many; None: 1
    variance: Tensor | None = None  # (B, H, W) of its mean colour, from its passes; of no meaning for one alone
    filtered: Tensor | None = None  # (B, H, W, 3) as a denoiser shows it


GLOSSY = 0.2
"""The directional albedo above which a pixel's glossy lobe is summed over lit points.

Glossy lobes are those that are neither diffuse nor followed by rays. Metals and rough glass exceed it, and coats at
grazing angles. Summing all lobes of plastics and varnish took a third of a training step and gained nothing.
"""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceInputs:
    """The guides that say how much a pixel reflects, as in `records.Guides`; they take no shadow ray."""

    emission: Tensor  # (B, H, W, 3) radiance × exposure
    specular: Tensor  # (B, H, W, 3)
    throughput: Tensor  # (B, H, W, 3)
    beyond_albedo: Tensor  # (B, H, W, 3)


SURFACE = tuple(field.name for field in fields(SurfaceInputs))


def reflectance(albedo: Tensor, surface: SurfaceInputs) -> Tensor:
    """The reflectance of a pixel, (B, H, W, 3): of its surface, or of the one seen in mirrors and through glass."""
    own = albedo + (surface.specular - surface.throughput).clamp(min=0)
    return own + surface.throughput * surface.beyond_albedo


def replace_albedo(albedo: Tensor, surface: SurfaceInputs) -> Tensor:
    """What a denoiser had better take for albedo, (B, H, W, 3): reflectance, at most 1, and 1 where lamps are seen."""
    lamp = surface.emission.amax(dim=-1, keepdim=True) > 0
    return torch.where(lamp, 1, reflectance(albedo, surface).clamp(max=1))


@dataclass(frozen=True, slots=True, eq=False)
class GuideInputs(SurfaceInputs):
    """The guides of each view, as in `records.Guides`; radiance × exposure."""

    direct: Tensor  # (B, H, W, 3)
    gloss: Tensor  # (B, H, W, 3)
    roughness: Tensor  # (B, H, W)
    mean_depth: Tensor  # (B, H, W) scene units, along the forward axis
    mean_normal: Tensor  # (B, H, W, 3)
    beyond_normal: Tensor  # (B, H, W, 3)
    beyond_depth: Tensor  # (B, H, W) scene units, along the path
    point_light: Tensor  # (B, L, 3) irradiance × exposure of the first points
    glossy_count: Tensor | None = None  # (B,) int64 on the host: glossy pixels of each sample that is on a card

    def reflect_at_least(self, least: float) -> Self:
        """These guides, with a `specular` of at least so much × (1 − roughness) on surfaces that have any other lobe.

        A dielectric of which the guides' rays found no reflection else counts as one that reflects nothing.
        """
        smooth = (1 - self.roughness) * (self.mean_depth > 0)
        return replace(self, specular=torch.maximum(self.specular, least * smooth[..., None]))

    def find_glossy(self) -> Tensor:
        """The pixels whose glossy lobe is summed, (B, H, W) bool; the same on all devices."""
        red, green, blue = (self.specular - self.throughput).unbind(-1)
        return red + green + blue > 3 * GLOSSY

    def count_glossy(self) -> Tensor:
        """Their number in each sample, (B,) int64."""
        return self.find_glossy().flatten(1).sum(dim=1)


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """The inputs of a predictor for a batch of samples; those it does not need are None."""

    world_to_camera: Tensor  # (B, 3, 4)
    depth: Tensor  # (B, H, W) along the forward axis, 0: nothing hit
    albedo: Tensor  # (B, H, W, 3)
    normal: Tensor  # (B, H, W, 3)
    points: PointInputs | None = None
    photons: PhotonInputs | None = None
    noisy: NoisyColour | None = None
    guides: GuideInputs | None = None
    surface: SurfaceInputs | None = None
    focal_px: Tensor | None = None  # (B,) focal lengths, pixels, where views have fields of view of their own

    @property
    def reflects(self) -> Tensor:
        """What denoisers take for albedo, (B, H, W, 3): where `surface` is given, by `replace_albedo`."""
        return self.albedo if self.surface is None else replace_albedo(self.albedo, self.surface)

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor], noisy: NoisyColour | None = None) -> Inputs:
        """The inputs that a `SceneDataset` has read, (B, …) by field, in the same memory; and noisy colour."""
        inputs = cls(tensors["world_to_camera"], tensors["depth"], tensors["albedo"], tensors["normal"], noisy=noisy)
        inputs = replace(inputs, focal_px=tensors.get("focal_px"))
        if POINTS[0] in tensors:
            surfaces = (tensors.get(name) for name in POINT_SURFACES)
            points = PointInputs(*(tensors[name] for name in POINTS), *surfaces)  # in their order
            inputs = replace(inputs, points=points)
        if PHOTONS[0] in tensors:
            arrays = {name.removeprefix("photon_"): tensors[name] for name in (*PHOTONS, "photon_seen")}
            inputs = replace(inputs, photons=PhotonInputs(**arrays, present=arrays["bounce"] >= 0))
        if tensors.keys() >= {*GUIDES}:
            inputs = replace(inputs, guides=GuideInputs(**{name: tensors[name] for name in GUIDES}))
        elif tensors.keys() >= {*SURFACE}:
            inputs = replace(inputs, surface=SurfaceInputs(**{name: tensors[name] for name in SURFACE}))
        return inputs

    def to(self, device: torch.device, *, copy: bool = False) -> Inputs:
        """These inputs on a device; themselves if they are there, unless a `copy` is asked for.

        What decides the size of tensors is counted before, and stays on the host, so that a card is not waited for.
        From pinned memory a card may still be copying when this returns.
        """
        ahead = is_asynchronous(device)
        guides = None if self.guides is None else replace(self.guides, glossy_count=None)
        moved = map_tensors(lambda x: x.to(device, non_blocking=ahead, copy=copy), replace(self, guides=guides))
        if self.guides is None or moved.guides is None or not ahead:
            return moved
        count = self.guides.glossy_count
        if count is None:
            count = self.guides.count_glossy().cpu()
        return replace(moved, guides=replace(moved.guides, glossy_count=count))


def require(member: M | None) -> M:
    """A member of the inputs that is needed; raises ValueError if it was not filled."""
    if member is None:
        raise ValueError("inputs: lack what the network needs; make them with the `Needs` of its architecture")
    return member


def map_tensors(change: Callable[..., Tensor], record: T, *others: T) -> T:
    """The record with `change` applied to each tensor, and to the matching ones of other records; None stays None."""

    def changed(values: list[Any]) -> Any:
        if isinstance(values[0], Tensor):
            return change(*values)
        return None if values[0] is None else map_tensors(change, *values)

    records = (record, *others)
    return replace(record, **{f.name: changed([getattr(r, f.name) for r in records]) for f in fields(record)})
