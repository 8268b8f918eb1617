"""A trained network and its scene, both loaded: the image of any configuration and view, on one device.

A network's inputs are rendered and handed on in the memory of the device that renders; on a processor nothing is
copied. So a frame is rendered, predicted and shown without a store, and costs what it has to.

Shape letters: H W image, P points, K photon slots.
"""

from __future__ import annotations

import copy
import logging
import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.core.errors import SpecError, say_install
from photonfarm.core.keys import make_key, view_key
from photonfarm.core.models import show_value
from photonfarm.core.processes import can_render
from photonfarm.core.records import arrays_of
from photonfarm.data.torch_dataset import OF_LIGHT
from photonfarm.farm.devices import AUTO, CPU
from photonfarm.plan.chosen import Chosen
from photonfarm.plan.request import sample_key
from photonfarm.scene.arrangement import Shot, find_doubts
from photonfarm.scene.modification import Modification, rebuild, rebuild_surfaces, rest
from photonfarm.scene.spec_loading import locate
from photonfarm.scene.view import Camera, View
from photonfarm.store import Store
from photonfarm.store.model.lease import announce_work
from photonfarm.store.read.find import Query, find_samples
from photonfarm.trainer.data.batch import choose_kept_pixels
from photonfarm.trainer.networks.inputs import (
    SURFACE,
    GuideInputs,
    Inputs,
    NoisyColour,
    PhotonInputs,
    PointInputs,
    SurfaceInputs,
)
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs.run_folder import make_environment

if TYPE_CHECKING:
    from photonfarm.core.records import Photons
    from photonfarm.renderer.jobs.truth import RefinedTruth, Truth
    from photonfarm.renderer.scene.floor_plan import FloorPlan
    from photonfarm.renderer.scene.loaded_scene import LoadedScene
    from photonfarm.scene.spec import Film, SceneSpec
    from photonfarm.trainer.predictors.evaluation import DevicePredictor


log = logging.getLogger(__name__)


def require_renderer(run: TrainedRun) -> None:
    """Raise SpecError if the renderer is not installed; otherwise let it find the run's scene."""
    if not can_render():
        raise SpecError(
            "what a network reads of a new view comes from the renderer, which is not installed here "
            f"({say_install('render')}); where it is, `photonfarm buffers --scene {run.scene_id}` writes a file of "
            "that along a camera path, for `photonfarm infer --buffers FILE`"
        )
    os.environ.update(make_environment(run.folder))


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A network's image of a configuration from a view, and what it was made from."""

    radiance: Tensor  # (H, W, 3) linear, on the network's device; differentiable with respect to the weights
    inputs: Inputs  # a batch of one, light × exposure
    configuration: Modification
    view: View
    seconds: Mapping[str, float]  # of the scene's edit, of the inputs, of the network; on a card, of the host alone
    beyond: tuple[str, ...]  # what the network never saw by the spec, each a sentence
    look_closer: Callable[[], tuple[str, ...]] = field(repr=False)  # `OpenRun.look_closer` of this frame

    @property
    def doubts(self) -> tuple[str, ...]:
        """What is doubtful, each a sentence, as `photonfarm infer` says it; rays are traced to find some."""
        return (*self.beyond, *self.look_closer())

    def __reduce__(self) -> tuple[Any, ...]:
        """The frame as a file or another process gets it: without the scene, but with what rays find in it."""
        *others, _ = (getattr(self, each.name) for each in fields(self))
        return Frame, (*others, partial(tuple, self.look_closer()))


@dataclass(frozen=True, slots=True)
class PlannedSample:
    """A sample that a view was planned as."""

    row: int
    new: bool  # planned now, and not before
    complete: bool

    def __str__(self) -> str:
        """The sample in words."""
        when, then = "" if self.new else " before", ", which is complete" if self.complete else ""
        return f"planned as a sample{when}, row {self.row}{then}"


class OpenRun:
    """A trained network and its scene. Not thread-safe: the scene is in one configuration at a time.

    `spec` is the scene's; `network` holds the weights.
    """

    def __init__(self, run: TrainedRun, store: str | Path, device: str = "auto", fov: float | None = None) -> None:
        """Load both, as `open_run` does; the network's device is by default the one that renders."""
        require_renderer(run)
        from photonfarm.renderer.jobs.render import load_scene
        from photonfarm.renderer.scene import backend

        source = run.scene(store)
        self.store = None if run.packed else Store(store)
        self.spec, self.scene_id = locate(source.spec), run.scene_id
        self._fov = Shot.of(fov=fov).fov
        geometry, self.cloud = source.base()
        self._scene: LoadedScene = load_scene(self.spec)
        torch.set_num_threads(run.settings.threads)
        self._run, self._needs, self._exposure = run, run.needs, self.spec.exposure
        self.architecture = run.settings.network.architecture
        if device == AUTO and backend.device().card is None:
            device = CPU
        self._predictor_of: Callable[[SceneSpec], DevicePredictor] = lambda spec: run.predictor(
            spec, (geometry, self.cloud), device
        )
        predictor = self._predictor_of(self.spec)
        self._images, self._device, self.network = predictor.images, predictor.device, predictor.network
        self._of_films: dict[Film, dict[str, Any]] = {}
        self._apply(rest(self.spec))

    def __repr__(self) -> str:
        return f"<run {self.describe()}>"

    def describe(self) -> str:
        """The network with its folder, the scene, the size of images and the device, in words."""
        film = self.spec.film
        scene = f"scene {self.spec.name} ({self.scene_id})"
        return f"{self._run.name}, {scene}, {film.width} × {film.height} pixels, on {self._device}"

    def with_film(self, film: Film) -> OpenRun:
        """The same in its present configuration, with images of another size; the network was not trained on that."""
        if film not in self._of_films:
            spec = self.spec.model_copy(update={"film": film})
            self._of_films[film] = {"spec": spec, "_images": self._predictor_of(spec).images}
        seen = copy.copy(self)
        for name, value in {**self._of_films[film], "_scene": self._scene.with_film(film)}.items():
            setattr(seen, name, value)
        return seen

    def predict(
        self,
        configuration: Modification | None = None,
        view: View | None = None,
        *,
        passes: int = 1,
        both: bool = False,
        **asked: Any,
    ) -> Frame:
        """The network's image of a configuration from a view.

        Both may be a sample's; by default they are the scene at rest and its first view. What is `asked` changes them:
        `place`, `move` and `without` by groups' names, `camera`, `look_at` and `fov`, as a `Shot` has them. A network
        that is given a noisy half gets one rendered, and guided_denoise the mean over `passes` of them; with `both`,
        the image is the mean of two, each from a half of its own. Raises SpecError for what is impossible,
        IncompleteError where photons or halves stay non-finite.
        """
        self._check_halves(passes, both=both)
        began = time.perf_counter()
        configuration, view = self.stage(configuration, view, **asked)
        staged = time.perf_counter()
        inputs = self._inputs(view)
        halves = [self._noisy(view, passes, other=other) for other in (False, True)[: 1 + both] if self._needs.kept]
        given = time.perf_counter()
        of_half = [replace(inputs, noisy=half) for half in halves] or [inputs]
        images = [self._images(each)[0] for each in of_half]
        radiance = (images[0] if len(images) == 1 else torch.stack(images).mean(0)) / self._exposure
        seconds = {"edit": staged - began, "inputs": given - staged, "network": time.perf_counter() - given}
        beyond = never_seen(find_doubts(self.spec, configuration, view))
        closer = partial(self.look_closer, configuration, view)
        return Frame(radiance, of_half[0], configuration, view, seconds, beyond, closer)

    def truth(
        self,
        configuration: Modification | None = None,
        view: View | None = None,
        *,
        spp: int | None = None,
        seconds: float | None = None,
        error: float | None = None,
        **asked: Any,
    ) -> Truth:
        """The image of the same by `bdpt`, with so many samples per pixel, for so many seconds, or so small an error.

        That is the image's own mean squared error as a share of its mean square. Else as `predict`.
        """
        from photonfarm.renderer.jobs.truth import Amount, render_truth

        amount = Amount(spp, seconds, error)
        _, view = self.stage(configuration, view, **asked)
        return render_truth(self._scene, view_key(self._key, view.vector), view, amount)

    def plan_sample(self, configuration: Modification, view: View) -> PlannedSample:
        """Plan it in the store as a sample that was chosen by hand, which workers find."""
        if self.store is None:
            raise SpecError(f"{self._run.folder}: a network on its own has no store to plan a sample in")
        stored = self.store.scene(self.scene_id)
        with announce_work(stored.storage, self.scene_id, "predict", log.warning):
            planned = stored.plan(chosen := Chosen.of(self.spec, configuration, view))
        (shot,) = chosen.shots
        key = sample_key(self.spec.radiance_id, shot.apply(self.spec), shot.view(self.spec).vector, 0)
        (found,) = find_samples(self.store, [self.scene_id], Query(sample=key)).samples
        return PlannedSample(found.row, planned.new > 0, found.complete)

    def draw_plan(self) -> FloorPlan:
        """The room from above; the scene comes to rest."""
        from photonfarm.renderer.scene.floor_plan import draw_floor_plan

        self.stage(rest(self.spec))
        return draw_floor_plan(self._scene)

    def refine(self, refined: RefinedTruth, frame: Frame) -> None:
        """Add one more pass to the truth of a frame."""
        _, view = self.stage(frame.configuration, frame.view)
        refined.add(self._scene, view_key(self._key, view.vector), view)

    def look_closer(
        self, configuration: Modification | None = None, view: View | None = None, **asked: Any
    ) -> tuple[str, ...]:
        """What stands in walls, or beyond them, and what the camera is inside of, each as a sentence; as `predict`.

        Samples may show that too, where boxes reach into walls: so it is not said that the network never saw it.
        """
        from photonfarm.renderer.scene.surroundings import look_closer

        configuration, view = self.stage(configuration, view, **asked)
        return tuple(look_closer(self._scene, configuration, view))

    def find_groups(
        self, configuration: Modification | None = None, view: View | None = None, **asked: Any
    ) -> NDArray[np.int16]:
        """The number of the group that each pixel's centre shows, (H, W), as `predict`: 0 is what never moves.

        Others are those of `spec.groups`, in their order, from 1 on, and −1 is nothing.
        """
        _, view = self.stage(configuration, view, **asked)
        return self._scene.find_groups([view])[0]

    def stage(
        self, configuration: Modification | None = None, view: View | None = None, **asked: Any
    ) -> tuple[Modification, View]:
        """Bring the scene into the configuration that is asked for, as `predict`; returns that and the view."""
        for given, kind in ((configuration, Modification), (view, View)):
            if not isinstance(given, kind | None):
                raise SpecError(f"{show_value(given)}: is no {kind.__name__}; names go with place = … or without = …")
        shot = Shot.of(**asked)
        if shot.fov is None:
            shot = shot.model_copy(update={"fov": self._fov})
        wanted, seen = shot.apply(self.spec, configuration), shot.view(self.spec, view)
        if not np.array_equal(wanted.vector, self._modification.vector):
            self._apply(wanted)
        return wanted, seen

    def _check_halves(self, passes: int, *, both: bool) -> None:
        """Raise SpecError where the network cannot be given so many passes, or both halves."""
        name = self._run.settings.network.architecture
        if passes < 1:
            raise SpecError(f"passes = {passes}: a half is the mean of at least 1")
        if passes > 1 and not self._needs.passes:
            raise SpecError(f"passes = {passes}: {name} is given no mean over passes; guided_denoise is")
        if both and not self._needs.kept:
            raise SpecError(f"both = True: {name} is given no noisy half; denoisers and guided_denoise are")

    def _apply(self, modification: Modification) -> None:
        """Bring the scene into a configuration, and its points and photons."""
        from photonfarm.renderer.jobs.estimates import photons_of
        from photonfarm.renderer.jobs.render import lit_points

        self._scene.apply(modification)
        self._modification, self._key = modification, modification.key(self.spec.radiance_id)
        self._lit = lit_points(self.cloud, modification)
        self._photons = photons_of(self._scene, self._key)[0] if self._needs.photons else None
        used = self._run.settings.network.points
        position, present = rebuild(self.cloud, modification)
        self._points = position[:used], present[:used]
        surfaces = rebuild_surfaces(self.cloud, modification) if self.spec.further_changes else ()
        self._surfaces = [values[:used] for values in surfaces]

    def _inputs(self, view: View) -> Inputs:
        """What the network reads of the present configuration from a view, a batch of one."""
        key, camera = view_key(self._key, view.vector), Camera.of(view, self.spec)
        given: dict[str, Tensor] = {}
        if self._needs.guides or self._needs.surface:
            wanted = self.spec.guides if self._needs.guides else self.spec.guides.without_shadows()
            ((buffers, guides),) = self._scene.inputs([view], [key], wanted, self._lit, take=take_torch)
            given = self._guide_tensors(arrays_of(guides))
        else:
            buffers = self._scene.buffers(view, take=take_torch)
        images = {name: self._tensor(image) for name, image in arrays_of(buffers).items()}
        return Inputs(
            world_to_camera=self._tensor(camera.world_to_camera.astype(np.float32)),
            focal_px=None if view.fov is None else torch.full((1,), camera.focal_px, device=self._device),
            depth=images["depth"],
            albedo=images["albedo"],
            normal=images["normal"],
            points=self._point_inputs(view) if self._needs.points else None,
            photons=None if self._photons is None else self._photon_inputs(view, self._photons),
            guides=GuideInputs(**given) if self._needs.guides else None,
            surface=SurfaceInputs(**{name: given[name] for name in SURFACE}) if self._needs.surface else None,
        )

    def _tensor(self, values: Any) -> Tensor:
        tensor: Tensor = values if isinstance(values, Tensor) else torch.from_numpy(np.ascontiguousarray(values))
        return tensor[None].to(self._device)

    def _guide_tensors(self, guides: dict[str, Any]) -> dict[str, Tensor]:
        factors = {name: self._exposure if name in OF_LIGHT else 1.0 for name in guides}
        return {name: self._tensor(image) * factors[name] for name, image in guides.items()}

    def _point_inputs(self, view: View) -> PointInputs:
        position, present = self._points
        seen = present & self._scene.sees([view], position)[0] if self._run.sees_points else present
        return PointInputs(*map(self._tensor, (position, present, seen, *self._surfaces)))

    def _photon_inputs(self, view: View, photons: Photons) -> PhotonInputs:
        present = photons.bounce >= 0
        arrays = arrays_of(photons) | {"bounce": photons.bounce.astype(np.float32), "present": present}
        arrays["seen"] = self._scene.sees([view], photons.position)[0] & present
        return PhotonInputs(**{name: self._tensor(values) for name, values in arrays.items()})

    def _noisy(self, view: View, passes: int = 1, *, other: bool = False) -> NoisyColour:
        """A noisy image of the view, or an `other` one, with as many pixels kept as in training.

        It is the mean over passes, with the variance of that, if the network is given several.
        """
        from photonfarm.renderer.jobs.estimates import half_of

        sample = make_key("frame", view_key(self._key, view.vector))
        numbers = range(passes * other, passes * (1 + other))
        keys = [make_key(sample, number) if number else sample for number in numbers]
        images = np.stack([half_of(self._scene, key, view) for key in keys]) * np.float32(self._exposure)
        kept, number, variance = choose_kept_pixels(sample, self.spec, self._needs.kept or 1), None, None
        if len(images) > 1:
            number = torch.full((1,), float(len(images)), device=self._device)
            variance = self._tensor(images.mean(axis=-1).var(axis=0, ddof=1) / len(images))
        return NoisyColour(self._tensor(images.mean(axis=0) * kept[..., None]), self._tensor(kept), number, variance)


def never_seen(doubts: Iterable[str]) -> tuple[str, ...]:
    """What no random sample shows, as the doubts of a network."""
    return tuple(f"{doubt}: the network never saw that" for doubt in doubts)


def take_torch(values: Any) -> Tensor:
    """Values of Dr.Jit as a tensor in the same memory."""
    tensor: Tensor = values.torch()
    return tensor
