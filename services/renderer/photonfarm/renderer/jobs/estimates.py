"""Estimates by seeds, which are functions of content keys: the halves of samples, and a configuration's photons.

A render with a non-finite value is discarded and drawn again with the next seed of its kind; no value is replaced or
clamped.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from itertools import count, islice
from typing import TYPE_CHECKING

import numpy as np

from photonfarm.core.errors import IncompleteError
from photonfarm.core.keys import Key, seed_of
from photonfarm.core.records import F32, Photons, arrays_of
from photonfarm.scene.view import View

if TYPE_CHECKING:
    from photonfarm.renderer.scene.loaded_scene import LoadedScene

ATTEMPTS = 3
"""The seeds tried for one render; three non-finite renders in a row are a fault of the scene, not bad luck."""

PURPOSES = ("half A", "half B")

log = logging.getLogger(__name__)


def halves_of(
    scene: LoadedScene, samples: Sequence[tuple[Key, View]], half_spp: int | None = None
) -> list[tuple[F32, int]]:
    """Two independent estimates of each view, (2, H, W, 3), by a sample's key, and the number of discarded renders.

    Samples given together are rendered together; `half_spp` is that of the spec unless it is given. Raises
    IncompleteError if estimates stay non-finite.
    """
    given = {} if half_spp is None else {"half_spp": half_spp}
    if not samples:
        return []
    seeds = [_first_seeds(key) for key, _ in samples]
    if len(samples) == 1:
        images = scene.render_halves(samples[0][1], seeds[0], **given)
    else:
        views = [view for _, view in samples for _ in PURPOSES]
        images = scene.render_images(views, [seed for pair in seeds for seed in pair], **given)
    estimates = []
    for (key, view), taken, halves in zip(
        samples, seeds, images.reshape(len(samples), 2, *images.shape[1:]), strict=True
    ):
        thrown = 0
        for half, purpose in enumerate(PURPOSES):
            if not np.isfinite(halves[half]).all():
                halves[half], more = _draw_again(scene, key, purpose, view, taken, given)
                thrown += more
        estimates.append((halves, thrown))
    return estimates


def half_of(scene: LoadedScene, key: Key, view: View) -> F32:
    """The first of a sample's two estimates alone, (H, W, 3); raises IncompleteError if it stays non-finite."""
    taken = _first_seeds(key)
    half = scene.render_half(view, taken[0])
    return half if np.isfinite(half).all() else _draw_again(scene, key, PURPOSES[0], view, taken, {})[0]


def _first_seeds(key: Key) -> tuple[int, int]:
    """Those of a sample's two estimates; they differ."""
    seed_a = next(_seeds(key, PURPOSES[0], ()))
    return seed_a, next(_seeds(key, PURPOSES[1], (seed_a,)))


def _draw_again(
    scene: LoadedScene, key: Key, purpose: str, view: View, taken: tuple[int, int], given: dict[str, int]
) -> tuple[F32, int]:
    """Another estimate in place of a non-finite one, with seeds that are not `taken`, and how many were discarded."""
    _log_discarded(key, purpose)
    for attempt, seed in enumerate(islice(_seeds(key, purpose, taken), ATTEMPTS - 1), start=1):
        image = scene.render_halves(view, (seed,), **given)[0]
        if np.isfinite(image).all():
            return image, attempt
        _log_discarded(key, purpose)
    raise IncompleteError(f"{purpose} of sample {key.hex()} came out non-finite {ATTEMPTS} times")


def photons_of(scene: LoadedScene, key: Key) -> tuple[Photons | None, int]:
    """The photons of the current configuration, by its key, and the number of attempts that were not finite.

    None for a spec without photons. Raises IncompleteError if they stay non-finite.
    """
    for thrown, seed in enumerate(islice(_seeds(key, "photons", ()), ATTEMPTS)):
        photons = scene.photons(seed)
        if photons is None or all(np.isfinite(values).all() for values in arrays_of(photons).values()):
            return photons, thrown
        _log_discarded(key, "photons")
    raise IncompleteError(f"photons of modification {key.hex()} came out non-finite {ATTEMPTS} times")


def _log_discarded(key: Key, purpose: str) -> None:
    log.warning("%s of %s is not finite; drawn again with another seed", purpose, key.hex())


def _seeds(key: Key, purpose: str, taken: tuple[int, ...]) -> Iterator[int]:
    """The seeds to try in turn, without end, none of them `taken`: equal seeds would make the halves equal."""
    for attempt in count():
        seed = seed_of(key, purpose if attempt == 0 else f"{purpose}, attempt {attempt}")
        if seed not in taken:
            yield seed
