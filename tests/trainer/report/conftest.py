"""A store with references and runs to report on, made once; tests that change something take a copy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from analytic_room import analytic_base, analytic_spec
from analytic_room_samples import commit_job
from random_inception import random_inception

from photonfarm.plan.hold_out import rows_held_out
from photonfarm.plan.request import Request
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.read.find import Query
from photonfarm.store.read.merge import merge_views
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.report import write_report
from photonfarm.trainer.report.contents import ReportContents, gather_contents
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.loop import train

HOLD_OUT = 0.4


@dataclass(frozen=True)
class Measured:
    """16 configurations of two passes of one view, references of all views, and two runs."""

    scene: SceneStore
    store: Path
    references: Path
    runs: Sequence[Path]  # light_transport, denoise_4

    def reader(self) -> SceneReader:
        """A fresh reader of the scene."""
        reader = SceneReader(self.store, self.scene.scene_id)
        reader.refresh()
        return reader

    def held_out(self, share: float = HOLD_OUT) -> list[int]:
        """The rows that this share holds out; the two passes of a view follow each other."""
        reader = self.reader()
        rows = reader.rows.tolist()
        return [row for row, held in zip(rows, rows_held_out(reader, rows, share), strict=True) if held]


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory, tiny, filled) -> Callable[..., TrainedRun]:
    """A run of a few steps with some changes of the settings; equal changes give the same one."""
    known: dict[str, TrainedRun] = {}

    def make(**changes: Any) -> TrainedRun:
        if (name := repr(changes)) not in known:
            folder = tmp_path_factory.mktemp("runs") / changes.get("network", {}).get("architecture", "run")
            settings: TrainSettings = tiny(**{"max_steps": 4, "hold_out": HOLD_OUT, **changes})
            train(SceneReader(filled.folder.parent.parent, filled.scene_id), settings, folder)
            known[name] = TrainedRun.load(folder)
        return known[name]

    return make


@pytest.fixture(scope="session")
def filled(tmp_path_factory: pytest.TempPathFactory) -> SceneStore:
    """The scene of `measured`."""
    scene = Store(tmp_path_factory.mktemp("measured") / "store", create=True).add(analytic_spec(16, 256))
    scene.write_base(*analytic_base(scene.spec))
    scene.plan(Request(modifications=16, passes=2), shard_rows=8)
    for job in range(scene.jobs()):
        commit_job(scene, job)
    return scene


@pytest.fixture(scope="session")
def measured(filled: SceneStore, trained) -> Measured:
    store = filled.folder.parent.parent
    references = store.parent / "references"
    references.mkdir()
    for key, merged in merge_views(filled, Query()):
        merged.write(references / f"{key}.npz")
    runs = [trained(network={"width": 4, "architecture": name}) for name in ("light_transport", "denoise_4")]
    return Measured(filled, store, references, [run.folder for run in runs])


@pytest.fixture(scope="session")
def compared(measured: Measured) -> ReportContents:
    """The comparison of both runs and a denoiser against references, without times."""
    runs, asked = [TrainedRun.load(run) for run in measured.runs], {"references": measured.references}
    with pytest.MonkeyPatch.context() as patch:  # the published network takes seconds for its features
        patch.setattr("photonfarm.trainer.compare.evaluate.load_inception", lambda *_: random_inception())
        return gather_contents(measured.store, runs, timed=False, denoisers=[("fill-in", 4)], **asked)


@pytest.fixture(scope="session")
def reported(measured: Measured, compared: ReportContents, tmp_path_factory) -> tuple[dict[str, Any], Path]:
    """The report of `compared`: its figures and its folder."""
    out = tmp_path_factory.mktemp("report")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("photonfarm.trainer.report.gather_contents", lambda *_, **__: compared)
        return write_report(measured.store, measured.runs, out), out


@pytest.fixture(scope="session")
def contents(measured: Measured) -> ReportContents:
    """The contents of one run, without references."""
    first = [TrainedRun.load(measured.runs[0])]
    return gather_contents(measured.store, first, timed=False)
