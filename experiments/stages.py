"""The stages of an experiment, each by a verb of photonfarm and each going on where it ended.

Everything lies in one folder: spec.json, store/, references/, runs/NAME/ and report/.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiment import Experiment, Run
from photonfarm.shared.processes import tied
from photonfarm.shared.verbs import command


class StageError(RuntimeError):
    """A verb that ended with another exit code than 0; says which, and where its output is."""


@dataclass(frozen=True, slots=True)
class Stages:
    """An experiment in its folder, with so many processes at a time."""

    experiment: Experiment
    folder: Path
    workers: int

    def run(self) -> Path:
        """All stages; the folder of the report."""
        self.write_spec()
        self.render()
        self.train()
        return self.report()

    def write_spec(self) -> None:
        """The spec as JSON. Raises SpecError."""
        self.folder.mkdir(parents=True, exist_ok=True)
        spec = self.experiment.spec().model_dump(mode="json")
        (self.folder / "spec.json").write_text(json.dumps(spec, indent=2) + "\n")

    def render(self) -> None:
        """The samples, further passes of some that are held out, and references of these."""
        size, spec = self.experiment.size, str(self.folder / "spec.json")
        samples = ["--modifications", size.modifications, "--views", size.views, "--seed", size.seed]
        store = ["--store", self.folder / "store"]
        self._verb("plan", ["submit", spec, *store, *samples, "--no-queue"])
        where = ["--where", f"held-out={size.hold_out:g}", "--where", f"views=first:{size.references.views}"]
        self._verb("plan", ["top-up", spec, *store, "--spp", size.references.spp, *where, "--no-queue"])
        farm = ["--workers", self.workers, "--train-steps", 0, "--run", self.folder / "farm", "--out", self.folder]
        self._verb("render", ["up", spec, *store, *samples, *farm])
        passes = -(-size.references.spp // (2 * self.experiment.spec().transport.half_spp))
        merge = ["store", "merge", *store, "--least", passes, "--out", self.folder / "references"]
        self._verb("references", merge)

    def train(self) -> None:
        """Every network, some at a time; one that is trained is left as it is."""
        with ThreadPoolExecutor(self.workers) as pool:
            for _ in pool.map(self._train, self.experiment.trained()):
                pass

    def report(self) -> Path:
        """The report of all networks and of the denoisers that nobody trained."""
        size, out = self.experiment.size, self.folder / "report"
        arguments: list[Any] = ["report", "--store", self.folder / "store", "--out", out]
        for run in self.experiment.trained():
            arguments += ["--run", self._folder(run)]
        arguments += ["--references", self.folder / "references"]
        arguments += [argument for name in size.untrained for argument in ("--denoiser", name)]
        arguments += [argument for kept in size.kept for argument in ("--kept", kept)]
        held_out = size.modifications * size.views * size.hold_out
        arguments += ["--samples", round(held_out)]  # further passes of the same views come after these
        self._verb("report", arguments)
        return out

    def _folder(self, run: Run) -> Path:
        return self.folder / "runs" / run.name

    def _train(self, run: Run) -> None:
        settings = {**run.train, "hold_out": self.experiment.size.hold_out}
        preset = settings.pop("preset")
        pairs = [argument for key, value in settings.items() for argument in ("--set", f"{key}={_text(value)}")]
        place = ["--store", self.folder / "store", "--run", self._folder(run), "--preset", preset]
        self._verb(f"train-{run.name}", ["train", self.folder / "spec.json", *place, *pairs])

    def _verb(self, stage: str, arguments: Sequence[Any]) -> None:
        """Run a verb to its end; what it says goes to a log. Raises StageError."""
        log = self.folder / "logs" / f"{stage}.log"
        log.parent.mkdir(exist_ok=True)
        began = time.monotonic()
        verb = command(*map(str, arguments))
        with log.open("ab") as output:
            code = subprocess.run(tied(verb), stdout=output, stderr=subprocess.STDOUT, check=False).returncode
        if code:
            last = log.read_text(errors="replace").strip().splitlines()[-1:]
            raise StageError(f"{self.experiment.name}: {stage} ended with exit code {code}; {log} says: {last}")
        tell(f"{self.experiment.name}: {stage} {time.monotonic() - began:.0f} s")


def tell(line: str) -> None:
    """A line about what goes on, with the time."""
    print(f"{time.strftime('%H:%M:%S')} {line}", file=sys.stderr, flush=True)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
