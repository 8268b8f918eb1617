"""Spans of time in words."""

from __future__ import annotations


def in_words(seconds: float) -> str:
    """A span of time as people say it: 45 s, 12 min, 3.4 h, 2.1 days."""
    if seconds < 100:
        return f"{max(seconds, 0):.0f} s"
    if seconds < 5940:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172800 else f"{seconds / 86400:.1f} days"
