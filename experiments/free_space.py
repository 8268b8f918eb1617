#!/usr/bin/env python3
"""Measures where the cameras of experiments may stand, as `photonfarm scene free-space` does.

    python experiments/free_space.py [NAME ...]

Without names it measures all. What it finds is kept in free_space.json beside this file, for every size; it is part of
the scenes' ids. Exit code 0, or 3 for a name that no experiment has, or a scene that cannot be loaded.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script this finds its own folder alone

from experiments.experiment import Experiment, keep_free_space, list_names
from experiments.stages import tell
from photonfarm.core.errors import SpecError


def main() -> int:
    """Measure them; returns the exit code."""
    from photonfarm.renderer.scene import backend

    backend.load(threads=1)
    from photonfarm.renderer.tools.measure.free_space import measure

    try:
        for name in sys.argv[1:] or list_names():
            measured = measure(Experiment.load(name, "small").spec_without_free_space(), None, tell)
            tell(f"{name}: {measured.line()}")
            keep_free_space(name, measured.space)
    except SpecError as error:
        tell(f"error: {error}")
        return SpecError.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
