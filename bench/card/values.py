"""Whether this device's values are those of LLVM: block means of halves, buffers and guides beside committed ones.

Halves are made from the same keys, so they differ by less than their standard errors where all is right; if the order
of random numbers has changed since the references were made, they differ by about one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.card.rooms import draw_view, load_room
from bench.harness import results
from photonfarm.core.keys import view_key
from photonfarm.core.records import arrays_of
from photonfarm.core.statistics import block_means

TITLE = "Values, beside those of LLVM"
SCENES = ("room", "cornell", "veach-ajar", "living-room-2")
REFERENCES = Path(__file__).with_name("references.json")
SIZE, HALF_SPP, HALVES = 64, 16, 32
BLOCKS, COARSE = 8, 4  # along a side: of halves, of inputs
MOST_Z, MOST_DIFFERENCE = 5.0, 0.01
"""The largest z of a block, and the largest difference of an input's block means, over its largest, that pass."""


def measure(name: str, _size: int, _out: Path, _limit_s: float) -> dict[str, Any]:
    """The block means of a scene, and how far they are from the references."""
    found = render_means(name)
    return {"means": found, **compare(found, json.loads(REFERENCES.read_text())[name])}


def render_means(name: str) -> dict[str, Any]:
    """Block means of one view: of halves with their standard errors, and of each channel of each input."""
    from photonfarm.renderer.jobs.render import lit_points

    scene = load_room(name, SIZE, HALF_SPP)
    modification, key, view = draw_view(scene, 0)
    cloud = scene.base()[1]
    scene.apply(modification)
    halves = np.stack([scene.render_half(view, seed) for seed in range(HALVES)])
    blocks = block_means(halves, BLOCKS).reshape(HALVES, -1)
    lit, keys = lit_points(cloud, modification), [view_key(key, view.vector)]
    ((buffers, guides),) = scene.inputs([view], keys, scene.spec.guides, lit)
    inputs = {**arrays_of(buffers), **arrays_of(guides)}
    return {
        "halves": rounded(blocks.mean(axis=0)),
        "errors": rounded(blocks.std(axis=0, ddof=1) / HALVES**0.5),
        "inputs": {what: rounded(average(np.asarray(values, np.float64))) for what, values in inputs.items()},
    }


def average(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means over blocks of an image, (H, W) or (H, W, C), by channel; of points, (L, C), over as many runs of them."""
    if values.shape[:2] != (SIZE, SIZE):
        return np.array([part.mean(axis=0) for part in np.array_split(values, COARSE**2)]).ravel()
    channels = values.reshape(SIZE, SIZE, -1)
    return np.array([block_means(channels[None, ..., c, None], COARSE) for c in range(channels.shape[-1])]).ravel()


def rounded(values: NDArray[np.float64]) -> list[float]:
    """Six digits of each."""
    return [float(f"{value:.6g}") for value in values.ravel()]


def compare(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """The z of halves' blocks, the ratio of their means, and the largest difference of each input over its largest."""
    here, there = (np.array(of["halves"]) for of in (found, wanted))
    squared = sum(np.square(of["errors"]) for of in (found, wanted))
    z = (here - there) / np.sqrt(np.maximum(squared, (1e-6 * np.abs(there).max()) ** 2))
    differences = {
        what: float(np.abs(np.subtract(found["inputs"][what], values)).max() / max(np.abs(values).max(), 1e-6))
        for what, values in wanted["inputs"].items()
    }
    right = np.abs(z).max() < MOST_Z and max(differences.values()) < MOST_DIFFERENCE
    return {
        "z_max": float(np.abs(z).max()),
        "z_rms": float(np.sqrt(np.mean(z**2))),
        "mean_ratio": float(here.mean() / there.mean()),
        "differences": differences,
        "verdict": "right" if right else "WRONG",
    }


def describe(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The table."""
    header = ("scene", "largest z", "rms z", "ratio of means", "largest difference of an input", "verdict")
    rows = []
    for name, of in found.items():
        worst = max(of["differences"], key=of["differences"].__getitem__)
        difference = f"{of['differences'][worst]:.1e} ({worst})"
        rows.append(
            [name, f"{of['z_max']:.2f}", f"{of['z_rms']:.2f}", f"{of['mean_ratio']:.5f}", difference, of["verdict"]]
        )
    return f"""One view of {SIZE}² in blocks of {SIZE // BLOCKS}², {HALVES} halves of {HALF_SPP} spp from the keys that
LLVM had; inputs in blocks of {SIZE // COARSE}², differences over the largest block.

{results.table(header, rows)}"""


def write_references() -> None:
    """Make the references of all scenes anew, on this device."""
    made = {name: render_means(name) for name in SCENES}
    lines = [f"{json.dumps(name)}: {json.dumps(of, separators=(',', ':'))}" for name, of in made.items()]
    REFERENCES.write_text("{\n" + ",\n".join(lines) + "\n}\n")
