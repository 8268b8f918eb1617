"""The cost of a frame from the scene to the image, on one machine in one run: rendering, buffers, points, network.

The renderer's verb measures its parts, in a process of its own; `evaluation` measures the network.
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photonfarm.core.archives import FrameCosts, Seconds
from photonfarm.core.errors import BackendError, say_install
from photonfarm.core.processes import can_render, command
from photonfarm.trainer.networks.inputs import Needs
from photonfarm.trainer.predictors.trained import ReadyPredictor, TrainedRun
from photonfarm.trainer.runs.run_folder import make_environment


@dataclass(frozen=True, slots=True)
class Machine:
    """The properties of a machine that times depend on."""

    cpu: str | None  # its model, if the system states it
    cores: int
    architecture: str
    load_average: tuple[float, float, float]  # processes that ran or waited to, in the last 1, 5 and 15 minutes

    @classmethod
    def here(cls) -> Machine:
        """The machine of this process, with its present load."""
        try:
            model = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        except OSError:  # another system
            model = None
        return cls(model and model[1], os.cpu_count() or 1, platform.machine(), os.getloadavg())

    @property
    def sentence(self) -> str:
        """The machine in words, on one line."""
        load = ", ".join(f"{average:.1f}" for average in self.load_average)
        return (
            f"{self.cpu or 'a CPU of unknown model'}, {self.cores} cores, {self.architecture}; load average {load} "
            "over 1, 5 and 15 minutes when times had been taken"
        )


VERB = "measure-frames"  # of the renderer
TIMED = 15  # frames
LONGEST_S = 10.0  # for all of them, and for each half that the longest is of


@dataclass(frozen=True, slots=True)
class FrameTime:
    """Seconds of one frame, by parts in the order in which they are made; None for parts that are not needed.

    These are halves A at 1/k of the pixels, depth with albedo and normal, the view's guides together with these (for
    denoisers that are given reflectance, without their shadow rays), which points of the cloud it sees, photons traced
    and seen, and the network. Editing the scene is left out, as it costs all the same.
    """

    parts: dict[str, Seconds | None]  # render, buffers, guides, points, photons, network

    @property
    def total(self) -> float:
        """The time of the whole frame: the sum of the medians."""
        return sum(part.median for part in self.parts.values() if part)

    def document(self) -> dict[str, Any]:
        """Its part of report.json: medians, 0 for unneeded parts, and the range of each part."""
        medians = {name: part.median if part else 0.0 for name, part in self.parts.items()}
        ranges = {name: [part.low, part.high] for name, part in self.parts.items() if part}
        return {**medians, "total": self.total, "ranges": ranges}


def measure_frame_costs(
    store: str | Path, run: TrainedRun, rows: Sequence[int], needs: Sequence[Needs], points: int | None
) -> FrameCosts:
    """The renderer's measurement of the frames in some rows of a run's scene, with so many points or all of the cloud.

    It renders the images that predictors with these needs are given. The renderer's own messages go
    to stderr. Raises BackendError with the reason if there is no measurement.
    """
    if not can_render():
        raise BackendError(
            f"the renderer, which makes buffers and photons, is not installed here: {say_install('render')}"
        )
    with tempfile.TemporaryDirectory(prefix="photonfarm-") as folder:
        file = Path(folder) / "frames.npz"
        asked = ["--store", str(store), "--scene", run.scene_id, "--out", str(file)]
        kept, halves = {each.kept for each in needs if each.kept}, {each.halves for each in needs}
        asked += ["--timed", str(TIMED), "--seconds", str(LONGEST_S * max(halves))]
        asked += [] if points is None else ["--points", str(points)]
        asked += [argument for row in rows for argument in ("--row", str(row))]
        asked += [argument for k in sorted(kept) for argument in ("--kept", str(k))]
        asked += [argument for n in sorted(halves - {1}) for argument in ("--halves", str(n))]
        verb, environment = command(VERB, *asked), make_environment(run.folder)
        if code := subprocess.run(verb, env=environment, stdout=subprocess.DEVNULL, check=False).returncode:
            raise BackendError(f"`photonfarm {VERB}` ended with exit code {code} here")
        return FrameCosts.read(file)


def count_points(runs: Sequence[TrainedRun]) -> int | None:
    """The most points whose visibility one of these networks needs; None for the whole cloud."""
    used = [run.settings.network.points for run in runs if run.sees_points]
    return None if None in used else max((points for points in used if points), default=None)


def assemble_frame_time(predictor: TrainedRun | ReadyPredictor, network: Seconds, costs: FrameCosts) -> FrameTime:
    """The parts that a predictor needs, with its network's seconds."""
    needs, parts = predictor.needs, costs.parts()
    guides = parts["guides_s"] if needs.guides else parts["surface_s"] if needs.surface else None
    is_plain = isinstance(predictor, ReadyPredictor) and predictor.denoiser == "none"
    return FrameTime(
        {
            "render": costs.renders()[needs.kept, needs.halves] if needs.kept else None,
            "buffers": None if guides or is_plain else parts["buffers_s"],
            "guides": guides,
            "points": parts["points_s"] if predictor.sees_points else None,
            "photons": Seconds.of(costs.photons_s + costs.photons_seen_s) if needs.photons else None,
            "network": network,
        }
    )
