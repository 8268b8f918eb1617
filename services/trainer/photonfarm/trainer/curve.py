"""Learning curves as SVG, with labelled axes; a plot of this one kind needs no plotting library."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 460, 300  # px
LEFT, RIGHT, TOP, BOTTOM = 64, 24, 12, 48  # px, margins of the plotting area


@dataclass(frozen=True, slots=True)
class Level:
    """A horizontal line to compare with."""

    name: str
    value: float
    colour: str


@dataclass(frozen=True, slots=True)
class Scale:
    """The plotting area: x from 0 to `right`, log10 y from `low` to `high`."""

    right: float
    low: float
    high: float

    def x(self, value: float) -> float:
        """Horizontal pixel of a value."""
        return LEFT + (WIDTH - LEFT - RIGHT) * value / self.right

    def y(self, value: float) -> float:
        """Vertical pixel of a value; values below the area lie on its lower edge."""
        part = (math.log10(max(value, 10**self.low)) - self.low) / (self.high - self.low)
        return TOP + (HEIGHT - TOP - BOTTOM) * (1 - part)


def learning_curve(points: Sequence[tuple[float, float]], levels: Sequence[Level], label: str) -> str:
    """An SVG of errors (x, error) on a logarithmic axis, with levels to compare them with; `label` names x."""
    scale = _scale(points, levels)
    path = " ".join(f"{scale.x(x):.1f},{scale.y(y):.1f}" for x, y in points)
    dots = "".join(f'<circle cx="{scale.x(x):.1f}" cy="{scale.y(y):.1f}" r="2.5" fill="#1f5fa8"/>' for x, y in points)
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" role="img" '
        f'aria-label="Held-out error over {escape(label)}" xmlns="http://www.w3.org/2000/svg">'
        f"{_axes(scale, label)}{''.join(_level(scale, level) for level in levels)}"
        f'<polyline points="{path}" fill="none" stroke="#1f5fa8" stroke-width="1.8"/>{dots}</svg>'
    )


def _scale(points: Sequence[tuple[float, float]], levels: Sequence[Level]) -> Scale:
    values = [v for v in (*(y for _, y in points), *(level.value for level in levels)) if v > 0] or [1.0]
    low, high = math.log10(min(values)) - 0.1, math.log10(max(values)) + 0.1
    return Scale(max((x for x, _ in points), default=0) or 1.0, low, high)


def _axes(scale: Scale, label: str) -> str:
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    marks = []
    for x in _round_steps(scale.right):
        at = scale.x(x)
        marks.append(f'<line x1="{at:.1f}" y1="{bottom}" x2="{at:.1f}" y2="{bottom + 4}" stroke="#555"/>')
        marks.append(_text(at, bottom + 17, f"{x:g}", "middle"))
    for y in _log_ticks(scale):
        at = scale.y(y)
        marks.append(f'<line x1="{LEFT}" y1="{at:.1f}" x2="{right}" y2="{at:.1f}" stroke="#e3e3e3"/>')
        marks.append(_text(LEFT - 6, at + 4, f"{y:g}", "end"))
    frame = f'<path d="M{LEFT},{TOP}V{bottom}H{right}" fill="none" stroke="#555"/>'
    names = _text((LEFT + right) / 2, HEIGHT - 10, label, "middle") + (
        f'<g transform="rotate(-90 14 {(TOP + bottom) / 2})">'
        f"{_text(14, (TOP + bottom) / 2, 'held-out squared error', 'middle')}</g>"
    )
    return "".join(marks) + frame + names


def _level(scale: Scale, level: Level) -> str:
    at = scale.y(level.value)
    return (
        f'<line x1="{LEFT}" y1="{at:.1f}" x2="{WIDTH - RIGHT}" y2="{at:.1f}" stroke="{level.colour}" '
        f'stroke-dasharray="5 4"/>{_text(WIDTH - RIGHT - 4, at - 4, level.name, "end", level.colour)}'
    )


def _text(x: float, y: float, text: str, anchor: str, colour: str = "#333") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="11" font-family="sans-serif" fill="{colour}" '
        f'text-anchor="{anchor}">{escape(text)}</text>'
    )


def _round_steps(right: float) -> list[float]:
    """About five round numbers from 0 to `right`."""
    raw = right / 5
    unit = 10 ** math.floor(math.log10(raw))
    step = next(unit * factor for factor in (1, 2, 5, 10) if unit * factor >= raw)
    return [i * step for i in range(int(right / step + 1e-9) + 1)]


def _log_ticks(scale: Scale) -> list[float]:
    """1, 2 and 5 times powers of ten in the range; powers of ten alone over more than two decades."""
    factors = (1, 2, 5) if scale.high - scale.low < 2 else (1,)
    decades = range(math.floor(scale.low), math.ceil(scale.high) + 1)
    return [f * 10.0**d for d in decades for f in factors if scale.low <= math.log10(f * 10.0**d) <= scale.high]
