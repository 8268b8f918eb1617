"""A scene that is loaded once and edited in place, and renders every sample."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.core.keys import Key, seed_of
from photonfarm.core.records import F32, NOTHING, STATIC, BasePointCloud, Geometry, Guides, Photons, ViewBuffers
from photonfarm.renderer.scene import backend
from photonfarm.scene.groups import shape_ids
from photonfarm.scene.modification import Modification, rest
from photonfarm.scene.spec import Film, GuideSpec, SceneSpec, Transport
from photonfarm.scene.view import View, sample_view

if TYPE_CHECKING:
    from photonfarm.renderer.scene.native import ChangingScene
    from photonfarm.renderer.scene.surroundings import Surroundings
    from photonfarm.renderer.scene.view_rays import Take


Lit = tuple[F32, F32]
"""Positions and normals (L, 3) of the points whose irradiance is required."""

GUIDE_VIEWS = 4
"""The views that a path guide is learned from."""

PIXELS_TOGETHER, MOST_TOGETHER = 1 << 15, 8
"""The most pixels, and the most samples, that are rendered together on a processor.

Some 15 ms of a sample go into launches, however small its image; more samples share them, but wait for each other.
"""

VECTOR = 16
"""The most lanes of a processor's vector: an image that ends within one would be rounded otherwise than alone."""

GUIDED_SAMPLES = 16
"""The samples that share the cost of a path guide where nothing moves; else 1, as each configuration learns its own."""


class LoadedScene:
    """A Mitsuba scene and its spec. Not thread-safe: it is in one configuration at a time.

    `scene` is the Mitsuba scene, for tests and comparisons; it belongs to this object. `boxes` (S, 2, 3) are the
    bounding boxes of its shapes at rest, by the scene's order; `still` (S,) says which shapes never move.

    `samples_at_once` is the number of samples, of one configuration, whose images should be rendered together: as many
    on a card as its memory holds, and on a processor a few of a small image, if they are to the bit what each is alone.
    """

    def __init__(self, spec: SceneSpec, scene: Any, paths_at_once: int | None = None) -> None:
        """Take over a Mitsuba scene; `paths_at_once` are the most paths in a launch, by default as the device likes."""
        from photonfarm.renderer.bdpt.recording import Recorders
        from photonfarm.renderer.scene.editing import MovableGroup
        from photonfarm.renderer.scene.loading import AimedSensor
        from photonfarm.renderer.scene.materials import Materials
        from photonfarm.renderer.scene.surroundings import boxes_of

        self.spec = spec = backend.for_this_device(spec)  # a card may have its own strategy: `transport.card`
        self.scene = scene
        self._sensor = AimedSensor(spec)
        paths_at_once = paths_at_once or backend.paths_at_once()
        self._integrator = integrator_of(spec.transport, paths_at_once)
        self.samples_at_once = _samples_at_once(spec, paths_at_once)
        self._recorders = Recorders()
        self._materials = Materials.of(scene)
        self._group_of = {shape: i for i, group in enumerate(spec.groups) for shape in shape_ids(group)}
        shapes = scene.shapes()
        self._groups = [MovableGroup(scene, group, spec) for group in spec.groups]
        self._shapes_of: list[dict[int, Any]] = [{} for _ in spec.groups]
        for number, shape in enumerate(shapes):
            if shape.id() in self._group_of:
                self._shapes_of[self._group_of[shape.id()]][number] = shape
        self._boxes_now = self.boxes = boxes_of(shapes)
        self._changing: ChangingScene | None = None
        self.still = np.array([shape.id() not in self._group_of for shape in shapes], np.bool_)
        # The corner that removed groups are parked in: see `editing`
        self._parking = self.boxes[self.still if self.still.any() else slice(None), 0].min(axis=0)
        self._path_guides: dict[Any, Any] = {}  # by integrator, of the present configuration
        self._distant = [emitter for emitter in scene.emitters() if emitter.get_shape() is None]
        self._state = rest(spec)
        self._of_films: dict[Film, dict[str, Any]] = {}

    @classmethod
    def load(cls, spec: SceneSpec, beside: Path | None = None, **options: Any) -> Self:
        """The scene of a spec, at rest; `beside` is the spec's folder, where its scene file may lie.

        Further `options` are those of the class.

        Raises SpecError for a scene that cannot be loaded or rendered, BackendError if Mitsuba does not work. Every
        movable group has been parked and brought back once, so that the kernels for this are compiled.
        """
        backend.load()
        from photonfarm.renderer.scene.loading import load_scene
        from photonfarm.renderer.scene.native import expect_changes

        loaded = cls(spec, load_scene(spec, beside), **options)
        if spec.groups:
            loaded._changing = expect_changes(loaded.scene)
        at_rest = rest(spec)
        loaded.apply(at_rest.without_groups())
        loaded.apply(at_rest)
        return loaded

    def apply(self, modification: Modification) -> None:
        """Bring the scene from any configuration into this one; only groups that change are edited.

        Raises SpecError for light that cannot be made by factors, before anything is edited.
        """
        before, turn, light = self._state, modification.turn, modification.light
        for group, factors in zip(self._groups, light, strict=True):
            group.check(factors)
        moved: dict[int, Any] = {}
        for i, group in enumerate(self._groups):
            present, was_present = bool(modification.present[i]), bool(before.present[i])
            stays = np.array_equal(modification.translation[i], before.translation[i]) and turn[i] == before.turn[i]
            if present and not (was_present and stays):
                group.move(modification.translation[i], turn[i])
                moved |= self._shapes_of[i]
            if present and not (was_present and np.array_equal(light[i], before.light[i])):
                group.shine(light[i])
            elif was_present and not present:
                group.park(self._parking)
                moved |= self._shapes_of[i]
        if not np.array_equal(modification.vector, self._state.vector):
            self.forget_path_guides()
        self._state = modification
        if moved:
            self._rebuild(moved)

    def _rebuild(self, moved: Mapping[int, Any]) -> None:
        """Have rays meet shapes, by their numbers, where they are now, and the scene know its bounding box."""
        from photonfarm.renderer.scene.surroundings import boxes_of

        boxes = self._boxes_now.copy()
        boxes[list(moved)] = boxes_of(list(moved.values()))
        has_same_box = np.array_equal(_around(boxes), _around(self._boxes_now))
        self._boxes_now = boxes
        if self._changing is not None and has_same_box:
            self._changing.rebuild(moved)
            return
        self.scene.parameters_changed([])  # Mitsuba rebuilds what depends on all shapes
        # It gives environment lights the old bounding sphere of the scene, and directional ones none
        for emitter in self._distant:
            emitter.set_scene(self.scene)

    def with_film(self, film: Film) -> Self:
        """The same scene in its present configuration, seen through another film; what edits this one edits both."""
        from photonfarm.renderer.bdpt.recording import Recorders
        from photonfarm.renderer.scene.loading import AimedSensor

        if film not in self._of_films:
            spec = self.spec.model_copy(update={"film": film})
            self._of_films[film] = {"spec": spec, "_sensor": AimedSensor(spec), "_recorders": Recorders()}
        seen = copy.copy(self)
        for name, value in self._of_films[film].items():
            setattr(seen, name, value)
        return seen

    def render_halves(self, view: View, seeds: Sequence[int], half_spp: int | None = None) -> F32:
        """Half-estimates of linear radiance for each seed, (K, H, W, 3), by the spec's integrator.

        They have the spec's `half_spp` samples per pixel unless it is given.
        """
        spp, guide = half_spp or self.spec.transport.half_spp, self._learn_path_guide(self._integrator)
        sensor = self._sensor.aim(view)
        return np.array(self._integrator.render_seeds(self.scene, sensor, seeds, spp, guide), np.float32)

    def render_images(self, views: Sequence[View], seeds: Sequence[int], half_spp: int | None = None) -> F32:
        """A half-estimate of each view by its seed, (K, H, W, 3), in as few launches as the device's memory allows.

        They are those of `render_halves`, up to rounding.
        """
        places = np.stack([self._sensor.place(view) for view in views])
        sensor, spp = self._sensor.at_origin, half_spp or self.spec.transport.half_spp
        guide = self._learn_path_guide(self._integrator)
        return np.array(self._integrator.render_seeds(self.scene, sensor, seeds, spp, guide, places), np.float32)

    def render_half(self, view: View, seed: int) -> F32:
        """One half-estimate, (H, W, 3)."""
        return self.render_halves(view, (seed,))[0]

    def render(self, view: View, seed: int, integrator: Any = None, spp: int | None = None) -> F32:
        """Linear radiance (H, W, 3), with another Mitsuba integrator or number of samples per pixel if given."""
        import drjit as dr
        import mitsuba as mi

        integrator = integrator or self._integrator
        guide = self._learn_path_guide(integrator)
        image = integrator.render(
            self.scene,
            sensor=self._sensor.aim(view),
            seed=dr.opaque(mi.UInt32, seed),
            spp=spp or self.spec.transport.half_spp,
            **({} if guide is None else {"guide": guide}),
        )
        return np.array(image, np.float32)

    def _learn_path_guide(self, integrator: Any) -> Any:
        """The path guide of the present configuration, learned once; None for an integrator without one.

        It follows from the configuration's content key alone: it is learned from a few views that are drawn as those of
        samples are. So both halves of a sample, every view and every worker have the same guide, and none of them
        shares a random number with it.
        """
        from photonfarm.renderer.bdpt.guiding.learning import Effort

        if not getattr(integrator, "guided_light", False):
            return None
        if integrator not in self._path_guides:
            spec, key = self.spec, self._state.key(self.spec.radiance_id)
            seed = seed_of(key, "guide of light paths")
            views = [sample_view(spec, key, seed, i, self._state) for i in range(GUIDE_VIEWS)]
            places = np.stack([self._sensor.place(view) for view in views])
            samples = 1 if spec.groups else GUIDED_SAMPLES
            eye_paths = 2 * spec.film.width * spec.film.height * spec.transport.half_spp * samples
            effort = Effort.for_image(eye_paths, integrator.light_ratio, integrator.connections)
            guide = integrator.learn_guide(self.scene, self._sensor.at_origin, seed, places, effort)
            self._path_guides[integrator] = guide
        return self._path_guides[integrator]

    def forget_path_guides(self) -> None:
        """Learn path guides anew, as for another configuration."""
        self._path_guides.clear()

    def buffers(self, view: View, take: Take | None = None) -> ViewBuffers:
        """The depth, albedo and normal buffers of a view in the present configuration; `take` as for `inputs`."""
        from photonfarm.renderer.scene.gbuffer import view_buffers
        from photonfarm.renderer.scene.view_rays import take_numpy

        return view_buffers(self.scene, [view], self.spec, self._recorders, take or take_numpy)[0]

    def inputs(
        self, views: Sequence[View], keys: Sequence[Key], wanted: GuideSpec, lit: Lit, take: Take | None = None
    ) -> list[tuple[ViewBuffers, Guides]]:
        """The buffers and the guides of views in the present configuration, whose seeds follow from the views' `keys`.

        `take` makes images of values of Dr.Jit, by default arrays of numpy. Albedo comes from the guides' rays.
        """
        from photonfarm.renderer.scene.gbuffer import with_albedo
        from photonfarm.renderer.scene.guides import view_guides
        from photonfarm.renderer.scene.view_rays import ViewCameras, take_numpy

        cameras, how = ViewCameras.of(views, self.spec), (self._recorders, take or take_numpy)
        of_views = view_guides(self.scene, cameras, self.spec, wanted, keys, self._materials, lit, *how)
        albedo, guides = zip(*of_views, strict=True)
        return list(zip(with_albedo(self.scene, cameras, albedo, *how), guides, strict=True))

    def sees(self, views: Sequence[View], position: F32) -> NDArray[np.bool_]:
        """Whether each view sees points (P, 3) of the present configuration, (K, P)."""
        from photonfarm.renderer.scene.gbuffer import find_seen_points

        return find_seen_points(self.scene, views, self.spec, position, self._recorders)

    def find_groups(self, views: Sequence[View]) -> NDArray[np.int16]:
        """What the rays through the pixels' centres meet in the present configuration, (K, H, W): numbers of groups.

        0 is what never moves, g + 1 group g of the spec, and −1 where the buffers have nothing.
        """
        from photonfarm.renderer.scene.gbuffer import find_shapes

        of_shapes = [self._group_of.get(shape.id(), STATIC) + 1 for shape in self.scene.shapes()]
        return np.array([*of_shapes, NOTHING], np.int16)[find_shapes(self.scene, views, self.spec, self._recorders)]

    @cached_property
    def hollow(self) -> NDArray[np.bool_]:
        """Which shapes are rooms and no solids, (S,): at rest, as groups that are away would count among the others."""
        from photonfarm.renderer.scene.surroundings import hollow_boxes

        return hollow_boxes(self.boxes)

    def surroundings(self, position: F32) -> Surroundings:
        """What surrounds points (N, 3) in the present configuration."""
        from photonfarm.renderer.scene.surroundings import surroundings

        return surroundings(self.scene, position, self.hollow)

    def photons(self, seed: int) -> Photons | None:
        """Surface hits of light sub-paths in the present configuration; None for a spec without photons."""
        from photonfarm.renderer.bdpt.photons import trace_photons

        wanted = self.spec.photons
        if not wanted.paths:
            return None
        hits = trace_photons(self.scene, seed=seed, paths=wanted.paths, depth=wanted.depth, recorders=self._recorders)
        return Photons(hits.position, hits.direction, hits.normal, hits.power, hits.bounce.astype(np.int8))

    def base(self) -> tuple[Geometry, BasePointCloud]:
        """Geometry and base point cloud of the scene at rest; the present configuration stays."""
        from photonfarm.renderer.scene.base_cloud import cloud_of, geometry_of

        before = self._state
        self.apply(rest(self.spec))
        geometry = geometry_of(self.scene.shapes(), self._group_of)
        cloud = cloud_of(self.scene, geometry, self.spec.points, self.spec.radiance_id)
        self.apply(before)
        return geometry, replace(cloud, pivots=self.spec.pivots)


def _around(boxes: F32) -> F32:
    """The box around boxes (S, 2, 3)."""
    return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def _samples_at_once(spec: SceneSpec, paths_at_once: int | None) -> int:
    """The samples whose halves share a launch of so many paths, at least one; None: as suits a processor."""
    from photonfarm.renderer.bdpt.launches import images_at_once, launches

    pixels, transport = spec.film.width * spec.film.height, spec.transport
    how = pixels, transport.half_spp, transport.light_ratio
    if paths_at_once is not None:
        return max(1, images_at_once(*how, paths_at_once) // 2)
    if any(launch.light_paths % VECTOR for launch in launches(1, *how)):  # pixels are a multiple of 64 in any case
        return 1
    return max(1, min(MOST_TOGETHER, PIXELS_TOGETHER // pixels))


def integrator_of(transport: Transport, paths_at_once: int | None = None) -> Any:
    """The integrator `bdpt` with the spec's parameters. Raises SpecError for those that it refuses."""
    import mitsuba as mi

    parameters = transport.model_dump(exclude={"half_spp", "card"})
    if paths_at_once is not None:
        parameters["paths_at_once"] = paths_at_once
    try:
        return mi.load_dict({"type": "bdpt", "record": True, **parameters})
    except (RuntimeError, ValueError) as error:
        raise SpecError(f"transport: {' '.join(str(error).split())}") from error
