"""The stages of an experiment, each by a verb of photonfarm and each going on where it ended.

Everything lies in one folder: spec.json, store/, references/, runs/NAME/ and report/; what the verbs said, in logs/.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.harness import results
from experiments.experiment import Experiment, Run
from photonfarm.core.errors import IncompleteError
from photonfarm.core.files import write_whole
from photonfarm.core.processes import command, tie
from photonfarm.plan.hold_out import rows_held_out
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.format.markers import COMMITTED

EVALUATION = "evaluation.json"  # what `evaluate` leaves in each run's folder
COMMITS = "commits.json"  # in each run's folder: at which commits it was trained
PATHS = "path.json"  # in an experiment's folder: rows of `path`
PREVIEW = "preview.html"  # what `up` makes last

REFERENCE = re.compile(r"([0-9a-f]{32})(\.partial)?\.npz")
"""A file that `store merge` leaves, by the key of its view."""


class StageError(IncompleteError):
    """A stage that did not come to its end; says which, and what to do or where its output is."""


@dataclass(frozen=True, slots=True)
class Stages:
    """An experiment in its folder, with so many processes at a time."""

    experiment: Experiment
    folder: Path
    workers: int
    until: float = math.inf  # by time.monotonic(): then what goes on later is stopped, and nothing else begins

    def run(self) -> Path:
        """All stages; the folder of the report. Raises StageError, and StoreError where store or runs are damaged."""
        self.write_spec()
        self.render()
        self.train()
        return self.report()

    def write_spec(self) -> None:
        """The spec as JSON. Raises SpecError."""
        self.folder.mkdir(parents=True, exist_ok=True)
        spec = self.experiment.spec().model_dump(mode="json")
        (self.folder / "spec.json").write_text(json.dumps(spec, indent=2) + "\n")

    # ----------------------------------------------------------------------------------------------------- rendering

    def render(self) -> None:
        """The samples, further passes of some that are held out, and references of these."""
        size, spec = self.experiment.size, str(self.folder / "spec.json")
        samples = ["--modifications", size.modifications, "--views", size.views, "--seed", size.seed]
        store = ["--store", self.folder / "store"]
        self._verb("plan", ["submit", spec, *store, *samples, "--no-queue"])
        where = ["--where", f"held-out={size.hold_out:g}", "--where", f"views=first:{size.references.views}"]
        self._verb("plan", ["top-up", spec, *store, "--spp", size.references.spp, *where, "--no-queue"])
        farm = ["--workers", self.workers, "--train-steps", 0, "--run", self.folder / "farm", "--out", self.folder]
        if self._scene.missing_jobs() or not (self.folder / PREVIEW).is_file():
            self._verb("render", ["up", spec, *store, *samples, *farm])
        self._merge()

    def _merge(self) -> None:
        """A reference of each view that is asked for, merged anew where anything was rendered since; and no other."""
        scene_id, out = self._scene_id, self.folder / "references"
        committed = self._scene.folder / COMMITTED  # renewed by every commit
        passes = -(-self.experiment.size.references.spp // (2 * self.experiment.spec().transport.half_spp))
        merge = ["store", "merge", "--store", self.folder / "store", "--scene", scene_id, "--least", passes]
        wanted = self._references()
        self._verb("references", [*merge, "--out", out], made=wanted, of=[committed])
        for file in out.iterdir():
            if REFERENCE.fullmatch(file.name) and file not in wanted:
                file.unlink()  # of an earlier spec, or of more views than are asked for now

    def _references(self) -> list[Path]:
        """The files of references of the first held-out views, in the order that `views=first:N` counts them."""
        size = self.experiment.size
        reader = SceneReader(self.folder / "store", self._scene_id)
        rows = {reader.view_row(row): row for row in reversed(reader.refresh().tolist())}
        shown = [row for _, row in sorted(rows.items())]
        sides = zip(reader.view_keys(shown), rows_held_out(reader, shown, size.hold_out), strict=True)
        wanted = [key.hex() for key, is_held_out in sides if is_held_out][: size.references.views]
        return [self.folder / "references" / f"{key}.npz" for key in wanted]

    @property
    def _scene(self) -> SceneStore:
        return Store(self.folder / "store").scene(self._scene_id)

    @property
    def _scene_id(self) -> str:
        return self.experiment.spec().scene_id

    # ------------------------------------------------------------------------------------------------------ training

    def train(self) -> None:
        """Every network, some at a time; one that is trained is left as it is.

        Raises StageError for a run of another scene or of other settings than are asked for, before anything is done.
        """
        missing = [run for run in self._runs() if not self._is_trained(run)]
        with ThreadPoolExecutor(self.workers) as pool:
            for _ in pool.map(self._train, missing):
                pass

    def _runs(self) -> list[Run]:
        return [*self.experiment.trained(), *self.experiment.again()]

    def _is_trained(self, run: Run) -> bool:
        """Whether a run has come to its end. Raises StageError where it is not of what is asked for."""
        from photonfarm.trainer.runs import checkpoint  # here, as it brings torch
        from photonfarm.trainer.runs.advice import LEARNED_BY_HEART
        from photonfarm.trainer.runs.run_folder import METRICS, read_log

        if not self._checkpoint(run).is_file():
            return False
        state = checkpoint.load(self._checkpoint(run))
        settings = {"scene_id": state["scene_id"], **state["settings"], **state["settings"]["network"]}
        asked = json.loads(json.dumps({"scene_id": self._scene_id, **self._asked(run)}))  # in the checkpoint's types
        differing = [
            f"{key} = {settings.get(key)!r}, and {value!r} is asked for now"
            for key, value in asked.items()
            if settings.get(key) != value
        ]
        if differing:
            raise StageError(
                f"{self.experiment.name}: {self._folder(run)} was trained with {'; '.join(differing)}: move that "
                "folder away, and it is trained anew"
            )
        seconds, log = sum(state["seconds"].values()), self._folder(run) / METRICS
        if state["step"] >= settings["max_steps"] or seconds >= (settings["max_seconds"] or math.inf):
            return True
        last = read_log(log)[-1:] if log.is_file() else []
        return any(record.get("reason") in ("rounds", LEARNED_BY_HEART) for record in last)

    def _asked(self, run: Run) -> dict[str, Any]:
        """The settings that its preset and the experiment's files name; all others are the trainer's defaults."""
        from photonfarm.trainer.runs.settings import find_preset

        preset = dict(find_preset(run.train["preset"], run.train["architecture"]))
        return {**preset.pop("network"), **preset, **self._settings(run)}

    def _settings(self, run: Run) -> dict[str, Any]:
        """What is set on top of its preset."""
        own = {key: value for key, value in run.train.items() if key != "preset"}
        return {**own, "hold_out": self.experiment.size.hold_out}

    def _train(self, run: Run) -> None:
        pairs = [
            part for key, value in self._settings(run).items() for part in ("--set", f"{key}={_format_text(value)}")
        ]
        place = ["--store", self.folder / "store", "--run", self._folder(run), "--preset", run.train["preset"]]
        self._check_time(f"train-{run.name}")
        self._keep_commit(run)
        self._verb(f"train-{run.name}", ["train", self.folder / "spec.json", *place, *pairs])
        if not self._is_trained(run):  # as one that is asked to stop exits with 0
            raise StageError(f"{self.experiment.name}: train-{run.name} was stopped early; the same command goes on")

    def _keep_commit(self, run: Run) -> None:
        """Add this checkout's commit to those at which a run was trained: several, if it was interrupted."""
        if (now := results.commit()) not in (commits := self._commits(run)):
            write_whole(self._folder(run) / COMMITS, json.dumps([*commits, now]) + "\n")

    def _commits(self, run: Run) -> list[str]:
        """The commits at which a run was trained; none where an earlier version trained it."""
        file = self._folder(run) / COMMITS
        commits: list[str] = json.loads(file.read_text()) if file.is_file() else []
        return commits

    def _folder(self, run: Run) -> Path:
        return self.folder / "runs" / run.name

    def _checkpoint(self, run: Run) -> Path:
        from photonfarm.trainer.runs.run_folder import CHECKPOINT

        return self._folder(run) / CHECKPOINT

    # -------------------------------------------------------------------------------------------------------- report

    def report(self) -> Path:
        """The report of the networks from the first seed and of ready denoisers; all others' errors too.

        Made anew where any of it is newer.
        """
        size, out = self.experiment.size, self.folder / "report"
        denoisers = [argument for name in size.untrained for argument in ("--denoiser", name)]
        denoisers += [] if self.experiment.has_features else ["--without-inception"]
        halves = [argument for halves in size.halves for argument in ("--halves", str(halves))]
        if size.untrained:  # these two options are for them
            denoisers += [*(argument for kept in size.kept for argument in ("--kept", str(kept))), *halves]
        self._measure("report", self.experiment.trained(), [*denoisers, "--out", out], out / "report.json")
        self._tell_commits(out / "report.json")
        if size.untrained:
            self._trace_paths()
        if again := self.experiment.again():
            halves = halves if any(run.is_given_halves for run in again) else []
            self._measure("evaluate", again, ["--without-inception", *halves], self._folder(again[0]) / EVALUATION)
        return out

    def _trace_paths(self) -> None:
        """What Mitsuba's `path` does in the time of a frame."""
        references, out = self.folder / "references", self.folder / PATHS
        asked = ["--store", self.folder / "store", "--scene", self._scene_id, "--references", references]
        asked += ["--hold-out", self.experiment.size.hold_out, "--out", out]
        program = [sys.executable, str(Path(__file__).parent / "path_tracing.py")]
        self._verb("path", asked, made=[out], of=[references], program=program)

    def _tell_commits(self, report: Path) -> None:
        """Write into report.json at which commits each run was trained, those of further seeds among them."""
        document = json.loads(report.read_text(encoding="utf-8"))
        trained_at = {run.name: self._commits(run) for run in self._runs()}
        if document.get("trained_at") != trained_at:
            text = json.dumps({**document, "trained_at": trained_at}, indent=2, ensure_ascii=False)
            write_whole(report, text + "\n")

    def _measure(self, verb: str, runs: Sequence[Run], more: Sequence[Any], made: Path) -> None:
        """What a verb makes of some runs against the references."""
        size, references = self.experiment.size, self.folder / "references"  # renewed by every file that comes or goes
        most = size.modifications * size.views  # so all that are held out
        arguments = [verb, "--store", self.folder / "store", "--references", references, "--samples", most, *more]
        arguments += [argument for run in runs for argument in ("--run", self._folder(run))]
        self._verb(verb, arguments, made=[made], of=[references, *(self._checkpoint(run) for run in runs)])

    # --------------------------------------------------------------------------------------------------------- verbs

    def _verb(
        self,
        stage: str,
        arguments: Sequence[Any],
        *,
        made: Sequence[Path] = (),
        of: Iterable[Path] = (),
        program: Sequence[str] = (),
    ) -> None:
        """Run a verb, or another program, to its end; what it says goes to a log. Raises StageError.

        One that leaves the files `made` is not run again while they are there, its arguments are the same and none of
        the files `of` is newer than its last end. It is not stopped either: it would begin anew, and might never end.
        """
        log, done = (self.folder / "logs" / f"{stage}{suffix}" for suffix in (".log", ".done"))
        asked = json.dumps([*map(str, arguments)])
        if made and _is_done(done, asked, made, of):
            return
        log.parent.mkdir(exist_ok=True)
        self._check_time(stage)
        began = time.monotonic()
        with log.open("ab") as output:
            line = [*program, *map(str, arguments)] if program else command(*map(str, arguments))
            process = subprocess.Popen(tie(line), stdout=output, stderr=subprocess.STDOUT)
        try:
            code = process.wait(None if made or math.isinf(self.until) else max(self.until - began, 0.0))
        except subprocess.TimeoutExpired:
            process.terminate()
            process.wait()
            what = f"the time is over, and {stage} was stopped"
            raise StageError(f"{self.experiment.name}: {what}; the same command goes on") from None
        if code:
            last = log.read_text(errors="replace").strip().splitlines()[-1:]
            raise StageError(f"{self.experiment.name}: {stage} ended with exit code {code}; {log} says: {last}")
        if made:
            done.write_text(asked)
        tell(f"{self.experiment.name}: {stage} {time.monotonic() - began:.0f} s")

    def _check_time(self, stage: str) -> None:
        """Raise StageError if no further stage may begin."""
        if time.monotonic() >= self.until:
            raise StageError(f"{self.experiment.name}: the time is over before {stage}; the same command goes on")


def _is_done(done: Path, asked: str, made: Iterable[Path], of: Iterable[Path]) -> bool:
    """Whether a verb's last end was that of these arguments, after all it is made of, and left what it makes."""
    if not done.is_file() or done.read_text() != asked or not all(file.is_file() for file in made):
        return False
    return all(source.stat().st_mtime_ns < done.stat().st_mtime_ns for source in of)


def tell(line: str) -> None:
    """A line about what goes on, with the time."""
    print(f"{time.strftime('%H:%M:%S')} {line}", file=sys.stderr, flush=True)


def _format_text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
