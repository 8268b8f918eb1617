"""Plan, write the scripts, and submit them to SLURM."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from photonfarm.core.errors import SchedulerError, store_errors

TRAINER = "trainer"
WORKERS = "workers"


@dataclass(frozen=True, slots=True)
class Launch:
    """The jobs of a launch."""

    workers: str  # the id of the array
    trainer: str | None  # the id of the trainer's job, if there is one
    scripts: dict[str, str]  # the files of both, by WORKERS and TRAINER
    logs: str  # the folder of their logs


def check_slurm() -> None:
    """Return if SLURM's commands are here; raises SchedulerError."""
    if shutil.which("sbatch") is None:
        raise SchedulerError(
            "sbatch is not here: photonfarm slurm runs where SLURM's commands are, such as a login node; --dry-run "
            "prints the scripts without them"
        )


def launch(scripts: Mapping[str, str], logs: Path) -> Launch:
    """Write scripts, by WORKERS and TRAINER, into the folder of the logs and submit them.

    The trainer's job starts once the first worker has: it trains on samples while they arrive. Raises StoreError if the
    folder cannot be written, SchedulerError if SLURM refuses.
    """
    files = {name: logs / f"{name}.sh" for name in scripts}
    with store_errors("write the scripts here", logs):
        logs.mkdir(parents=True, exist_ok=True)
        for name, file in files.items():
            file.write_text(scripts[name])
            file.chmod(0o755)
    workers = _submitted(files[WORKERS])
    trainer = None
    if TRAINER in files:
        try:
            trainer = _submitted(files[TRAINER], f"--dependency=after:{workers.partition(';')[0]}_0")
        except SchedulerError as error:
            raise SchedulerError(f"{error}. The workers are submitted, as job {workers}") from error
    return Launch(workers, trainer, {name: str(file) for name, file in files.items()}, str(logs))


def _submitted(script: Path, *options: str) -> str:
    """The id of a submitted job, with its cluster behind a semicolon if SLURM names one."""
    words = ["sbatch", "--parsable", *options, str(script)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        said = " ".join(done.stderr.split()) or f"exit code {done.returncode}"
        raise SchedulerError(f"sbatch refused {script}: {said}")
    return done.stdout.strip()
