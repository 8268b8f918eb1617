"""A dry run in words and as JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from photonfarm.shared.core.waiting import in_words
from photonfarm.trainer.dry_run.cards import UTILISATION
from photonfarm.trainer.dry_run.dry_run import DryRun


def document(found: DryRun) -> dict[str, Any]:
    """The estimate for programs: its fields, what follows from them, and what is assumed."""
    derived = {"step_flops": found.step_flops, "memory_bytes": found.memory_bytes, "seconds": found.seconds}
    return {**asdict(found), **derived, "assumed_utilisation": dict(UTILISATION)}


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
        f"here         {_seconds(timed.step_s)} a step, {rate:,.0f} GFLOP/s, {in_words(found.seconds)} in all, on "
        f"{timed.device}",
        f"             (median of {timed.steps} steps of {timed.samples}{of}, on made-up samples; without reading, "
        "waiting, validation)",
        "",
        *_cards(found),
        "",
        "The hours of a card are work over its peak rate by the data sheet times an assumed share: "
        + ", ".join(f"{share:g} in {name}" for name, share in UTILISATION.items())
        + ". No card was measured; steps of a few milliseconds take longer, as they do not fill a card.",
    ]
    return "\n".join(lines)


def _cards(found: DryRun) -> list[str]:
    """A line for each card."""
    head = f"{'GPU-hours':<13}" + "".join(f"{name:>10}" for name in UTILISATION)
    lines = []
    for card in found.cards:
        hours = "".join(f"{_hours(card.hours[name]):>10}" for name in UTILISATION)
        lines.append(f"{card.card:<13}{hours}" + ("" if card.fits else f"   {card.memory_gb:g} GB are too few"))
    return [head, *lines]


def _hours(hours: float) -> str:
    return f"{hours:,.1f}" if hours >= 0.1 else "< 0.1"


def _size(size: float) -> str:
    return f"{size / 1e9:.2f} GB" if size >= 1e8 else f"{size / 1e6:.1f} MB"


def _seconds(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds >= 10 else f"{seconds * 1e3:.0f} ms"
