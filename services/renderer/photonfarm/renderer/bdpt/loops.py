"""Symbolic loops, traced once."""

from __future__ import annotations

from typing import Any

import drjit as dr


def traced_once(**arguments: Any) -> tuple[Any, ...]:
    """``dr.while_loop`` in symbolic mode, without the second tracing by which Dr.Jit looks for loop-invariant state.

    Tracing is most of the time of a small image, and these loops have next to no invariant state to find.
    """
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        return dr.while_loop(mode="symbolic", **arguments)
