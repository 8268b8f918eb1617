"""Cards by name, and the hours that a training's work takes on them, by an assumed share of their peak rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from photonfarm.trainer.runs.settings import Precision


@dataclass(frozen=True, slots=True)
class Card:
    """A card's peak rates by NVIDIA's data sheets: without sparsity, with sums in float32."""

    name: str
    memory_gb: float  # 10⁹ bytes
    tflops: Mapping[Precision, float]  # 10¹² operations a second


def _card(name: str, memory_gb: float, float32: float, tf32: float, bfloat16: float) -> Card:
    return Card(name, memory_gb, {"float32": float32, "tf32": tf32, "bfloat16": bfloat16})


CARDS = (
    _card("L4", 24, 30.3, 60, 121),
    _card("RTX 4090", 24, 82.6, 82.6, 165),
    _card("L40S", 48, 91.6, 183, 362),
    _card("A100 SXM", 80, 19.5, 156, 312),
    _card("H100 SXM", 80, 67, 495, 989),
    _card("H200 SXM", 141, 67, 495, 989),
)

UTILISATION: Mapping[Precision, float] = {"float32": 0.5, "tf32": 0.35, "bfloat16": 0.25}
"""The assumed share of the peak rate that training reaches; none of it was measured on a card.

Each of the U-Net's four levels has a quarter of the work. Outside, at 64 channels, a pixel has some 74 kFLOP a
convolution for about 1 kB that is read and written in bfloat16, a quarter of what tensor cores of an H100 need to be
busy; inside, convolutions are large enough. A narrower network, or a few small images, reaches less. No precision is
taken to be slower than float32.
"""


@dataclass(frozen=True, slots=True)
class CardHours:
    """The estimate for a card."""

    card: str
    memory_gb: float
    fits: bool  # the estimated memory
    hours: dict[Precision, float]  # of one card, by precision


def on_cards(flops: float, needed_bytes: float) -> list[CardHours]:
    """The hours of each card for so many operations; `needed_bytes` is the memory of a step."""
    found = []
    for card in CARDS:
        rates = {name: 1e12 * peak * UTILISATION[name] for name, peak in card.tflops.items()}
        hours = {name: flops / max(rate, rates["float32"]) / 3600 for name, rate in rates.items()}
        found.append(CardHours(card.name, card.memory_gb, needed_bytes <= card.memory_gb * 1e9, hours))
    return found
