"""What a frame costs from the scene to the image, on one machine in one run: rendering, buffers, points, network.

The parts that a renderer makes are measured by its verb, in a process of its own; the network by `evaluation`.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from photonfarm.shared.frame_costs import FrameCosts
from photonfarm.shared.verbs import command, is_installed
from photonfarm.trainer.trained import TrainedRun
from photonfarm.trainer.untrained import Untrained

VERB = "measure-frames"  # of the renderer


@dataclass(frozen=True, slots=True)
class FrameTime:
    """Wall seconds of one frame, by parts, each the median over frames; what a predictor does not need is 0.

    Editing the scene is not in it, which all do alike.
    """

    render: float  # of half A, at 1/k of the pixels
    buffers: float  # depth, albedo, normal
    points: float  # which points of the cloud the view sees
    photons: float  # tracing them, and which the view sees
    network: float

    @property
    def total(self) -> float:
        """Of the whole frame."""
        return self.render + self.buffers + self.points + self.photons + self.network


def measured_costs(store: str | Path, scene_id: str, rows: Sequence[int], kept: Sequence[int]) -> FrameCosts | str:
    """What the renderer measures of the frames in some rows; or why it does not: what it said stands on stderr."""
    if not is_installed(VERB):
        return "the renderer, which makes buffers and photons, is not installed here"
    with tempfile.TemporaryDirectory(prefix="photonfarm-") as folder:
        file = Path(folder) / "frames.npz"
        asked = ["--store", str(store), "--scene", scene_id, "--out", str(file)]
        asked += [argument for row in rows for argument in ("--rows", str(row))]
        asked += [argument for k in sorted(set(kept)) for argument in ("--kept", str(k))]
        if code := subprocess.run(command(VERB, *asked), stdout=subprocess.DEVNULL, check=False).returncode:
            return f"`photonfarm {VERB}` ended with exit code {code} here"
        return FrameCosts.read(file)


def frame_time(predictor: TrainedRun | Untrained, network: float, costs: FrameCosts) -> FrameTime:
    """The parts that a predictor needs, with its network's seconds."""
    needs, parts = predictor.needs, costs.medians()
    exact = isinstance(predictor, TrainedRun) and predictor.settings.network.occlusion == "exact"
    return FrameTime(
        render=costs.render_medians()[needs.kept] if needs.kept else 0.0,
        buffers=parts["buffers_s"],
        points=parts["points_s"] if needs.points and exact else 0.0,
        photons=parts["photons_s"] + parts["photons_seen_s"] if needs.photons else 0.0,
        network=network,
    )
