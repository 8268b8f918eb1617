"""A small spec and made-up measurements of it, for what is asked of plans."""

import tomllib
from typing import Any

from photonfarm.renderer.scene import backend

backend.load(threads=1)

from photonfarm.renderer.strategy.candidates import (  # noqa: E402 - after the variant is set
    PLAIN,
    Candidate,
    ImageCost,
    MeasuredCandidate,
    RelativeErrors,
)
from photonfarm.renderer.strategy.content import LightReach  # noqa: E402
from photonfarm.renderer.strategy.measurement import Measurement  # noqa: E402
from photonfarm.renderer.strategy.noise import Purpose  # noqa: E402
from photonfarm.scene.spec import Film, SceneSpec  # noqa: E402
from photonfarm.scene.spec_loading import parse_spec  # noqa: E402

SPEC = """
name = "small-box"  # the box
[scene]
builtin = "cornell"
[view]
origin = { min = [-0.5, 0.5, 1], max = [0.5, 1.5, 1.8] }
look_at = { min = [-0.5, 0.5, -0.5], max = [0.5, 1.5, 0] }
[film]
width = 16
height = 16
[transport]
max_depth = 3  # edges
half_spp = 2
[photons]
paths = 64
"""


def spec_with(**transport: Any) -> SceneSpec:
    document = tomllib.loads(SPEC)
    document["transport"] |= transport
    return parse_spec(document, where="spec")


LIGHT, JOINED = Candidate(0, 1.0), Candidate(1, 1.0)


def row(candidate: Candidate, error: float, fixed_s: float, sample_s: float, scatter: float = 0.1) -> MeasuredCandidate:
    """`scatter`: how far the errors of three views differ from their mean; √3 times the standard error of a ratio."""
    own = tuple(error * (1 + scatter * d) for d in (-1, 0, 1)) if candidate != PLAIN else (error,) * 3
    return MeasuredCandidate(
        candidate=candidate,
        missed=0.0,
        cost=ImageCost(fixed_s, sample_s),
        errors=RelativeErrors(images=12, own=own, plain=(0.2,) * 3),
    )


def measurement(*rows: MeasuredCandidate) -> Measurement:
    """The measurement of a spec with (1, 1) and 2 samples per pixel."""
    default = (row(PLAIN, 0.2, 0.01, 0.01), row(LIGHT, 0.05, 0.02, 0.02), row(JOINED, 0.05, 0.02, 0.04))
    return Measurement(
        purpose=Purpose.IMAGES,
        film=Film(width=16, height=16),
        spp=2,
        half_s=0.1,
        views=3,
        modelled=("lights: 1 area",),
        left_out=(),
        rows=rows or default,
        shared=0.0,
        reach=LightReach(configurations=1, hit=1.0, near=1.0, beyond=(0.3, 0.005, 0.0)),
        asked_s=60.0,
        spent_s=5.0,
        device="cpu",
    )
