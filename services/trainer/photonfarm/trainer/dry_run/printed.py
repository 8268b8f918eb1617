"""A dry run in words and as JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from photonfarm.core.waiting import format_span
from photonfarm.trainer.dry_run.dry_run import DryRun


def document(found: DryRun) -> dict[str, Any]:
    """The estimate for programs: its fields, and what follows from them."""
    derived = {"step_flops": found.step_flops, "memory_bytes": found.memory_bytes, "seconds": found.seconds}
    return {**asdict(found), **derived}


def text(found: DryRun) -> str:
    """The estimate for people."""
    work, timed, batch = found.work, found.timed, found.batch
    parts = (
        ("activations", batch * work.activation_bytes),
        ("batch", batch * work.sample_bytes),
        ("weights, gradients, optimiser", found.state_bytes),
    )
    rate = found.step_flops / timed.step_s / 1e9
    of = "" if timed.samples == batch else f", times {batch}/{timed.samples}"
    lines = [
        f"{found.architecture} for {found.scene}: {found.film[0]} × {found.film[1]} pixels, width {found.width}, "
        f"{found.precision}",
        f"parameters   {found.parameters:,}",
        f"steps        {found.steps:,} of {batch} samples, {found.steps * batch:,} draws",
        f"work         {found.step_flops / 1e9:,.1f} GFLOP a step, forward and backward",
        f"memory       {_size(found.memory_bytes)} at least: "
        + ", ".join(f"{name} {_size(size)}" for name, size in parts),
        *([] if timed.peak_bytes is None else [f"             {_size(timed.peak_bytes)} at the timed steps"]),
        f"here         {_seconds(timed.step_s)} a step, {rate:,.0f} GFLOP/s, {format_span(found.seconds)} in all, on "
        f"{timed.device}",
        f"             (median of {timed.steps} steps of {timed.samples}{of}, on made-up samples; without reading, "
        "waiting, validation)",
    ]
    return "\n".join(lines)


def _size(size: float) -> str:
    return f"{size / 1e9:.2f} GB" if size >= 1e8 else f"{size / 1e6:.1f} MB"


def _seconds(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds >= 10 else f"{seconds * 1e3:.0f} ms"
