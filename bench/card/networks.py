"""A training step and a frame of every architecture, on the room at the supplement's sizes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.card.rooms import make_once, on_card
from bench.harness import results
from bench.trainer.train_step import WHOLE, WorkTimer, filled, for_architecture, resized, time_step
from photonfarm.trainer.runs.settings import make_preset

TITLE = "A training step and a frame"
BATCH, REPETITIONS, SAMPLES = 32, 7, 96


def measure(architecture: str, size: int, out: Path, _limit_s: float) -> dict[str, Any]:
    """Milliseconds of a step and of an image alone, whose inputs lie on the device."""
    import torch

    torch.set_num_threads(1)
    device, batch, precision = ("cuda", BATCH, "bfloat16") if on_card() else ("cpu", 2, "float32")
    preset = make_preset("paper-dynamic", device=device, batch=batch, network={"precision": precision})
    settings, clock = for_architecture(preset, architecture), WorkTimer(device, REPETITIONS)
    spec = resized(size, settings.network.points)
    where = out / f"store-{size}", spec.scene_id
    make_once(where[0], lambda root: filled(spec, root, SAMPLES))
    parameters, step, _ = time_step(where, settings, clock)
    _, _, frame = time_step(where, settings.model_copy(update={"batch": 1}), clock)
    peak_gb = torch.cuda.max_memory_allocated() / 1e9 if on_card() else 0.0
    fixed = settings.model_copy(update={"deterministic": True})  # measured last, as it stays on
    fixed_ms = time_step(where, fixed, clock)[1][WHOLE] if on_card() else None
    return {
        "parameters": parameters,
        "batch": settings.batch,
        "precision": settings.network.precision,
        "step_ms": step[WHOLE],
        "frame_ms": frame[WHOLE],
        "peak_gb": peak_gb,
        "deterministic_ms": fixed_ms,
    }


def describe(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The table."""
    header = ("architecture", "parameters", "step, ms", "deterministic, ms", "frame, ms", "most memory, GB")
    told = ("step_ms", "deterministic_ms", "frame_ms", "peak_gb")
    rows = [
        [f"`{name}`", of["parameters"], *("–" if of[key] is None else f"{of[key]:.1f}" for key in told)]
        for name, of in found.items()
    ]
    first = next(iter(found.values()))
    return f"""`paper-dynamic` in {first["precision"]}: a step of {first["batch"]} samples with its optimiser, and the
network's part of a frame, in processor time or a card's; medians of {REPETITIONS}. `deterministic` is a card's
alone.

{results.table(header, rows)}"""
