"""What samples are for, and how the noise of their pixels counts for that."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from functools import partial
from typing import TypeAlias

from photonfarm.renderer.strategy.noise import training_weights, view_weights
from photonfarm.shared.core.records import F32

Weigh: TypeAlias = Callable[[Sequence[F32]], F32 | None]
"""Images of a view → the factors on its pixels, (H, W, 3), whose squares weigh variance; None for a black view."""


class Purpose(StrEnum):
    """What samples are for."""

    TRAINING = "training"  # targets of a network, weighed as the trainer's relative loss does
    IMAGES = "images"  # images to look at, or references

    def weigh(self, exposure: float) -> Weigh:
        """How the noise of pixels counts, in a scene of this exposure."""
        return partial(training_weights, exposure=exposure) if self is Purpose.TRAINING else view_weights
