"""What is asked of the renderer where it is installed: its verbs, as child processes, as the farm knows no renderer."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from photonfarm.core.errors import BackendError, StoreError, say_install
from photonfarm.core.processes import can_render, command
from photonfarm.plan.sample_costs import SampleCosts
from photonfarm.scene.arrangement import find_doubts, list_shot
from photonfarm.scene.modification import Modification
from photonfarm.scene.shot_files import name_frames
from photonfarm.scene.spec_loading import NamedSpec
from photonfarm.scene.view import View

MOST_LOOKED_AT = 64
"""The most views that are looked at closely, as each may take a third of a second."""

MOST_DOUBTS = 8
"""The most doubts that are said."""


def measure_costs(spec: str, seconds: float) -> SampleCosts:
    """The costs that the renderer measures for a spec in so much processor time, or has kept.

    Raises BackendError with the reason for none.
    """
    said = _ask("scene", "cost", "--json", "--seconds", f"{seconds:g}", "--", spec)
    try:
        return SampleCosts.read(said)
    except StoreError as error:
        raise BackendError(f"`photonfarm scene cost` said {error}") from error


def collect_doubts(
    named: NamedSpec, shots: Sequence[tuple[Modification, View]], log: Callable[[str], object]
) -> list[str]:
    """What is doubtful of chosen configurations and views, as `name_frames` says it; of the first by surfaces, too.

    `log` is called with the reason if surfaces are not looked at.
    """
    doubts: list[str] = []
    listed = [list_shot(named.spec, *shot) for shot in shots[:MOST_LOOKED_AT]]
    with tempfile.TemporaryDirectory() as folder:
        (file := Path(folder, "shots.json")).write_text(json.dumps(listed))
        try:
            said = _ask("scene", "check", "--json", "--configurations", str(file), "--", named.name)
            doubts = [*map(str, json.loads(said))]
        except BackendError as error:
            log(f"whether anything stands in a wall is not known: {error}")
            listed = []
    doubts += name_frames([find_doubts(named.spec, *shot) for shot in shots[len(listed) :]], len(listed))
    return doubts[:MOST_DOUBTS] + [f"and {len(doubts) - MOST_DOUBTS} more like these"] * (len(doubts) > MOST_DOUBTS)


def _ask(*arguments: str) -> bytes:
    """What a verb prints; it talks to stderr. Raises BackendError if it fails, and where there is no renderer."""
    if not can_render():
        raise BackendError(f"the renderer is not installed here: {say_install('render')}")
    done = subprocess.run(command(*arguments), stdout=subprocess.PIPE, check=False)
    if done.returncode:
        raise BackendError(f"`photonfarm {' '.join(arguments[:2])}` ended with exit code {done.returncode} here")
    return done.stdout
