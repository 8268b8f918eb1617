"""The machine that a report's times were taken on."""

from __future__ import annotations

import os
import platform
import re
from dataclasses import dataclass
from pathlib import Path

CPU_INFO = Path("/proc/cpuinfo")


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
        return cls(_model(), os.cpu_count() or 1, platform.machine(), os.getloadavg())

    @property
    def stated(self) -> str:
        """The machine in words, on one line."""
        load = ", ".join(f"{average:.1f}" for average in self.load_average)
        return (
            f"{self.cpu or 'a CPU of unknown model'}, {self.cores} cores, {self.architecture}; load average {load} "
            "over 1, 5 and 15 minutes when times had been taken"
        )


def _model() -> str | None:
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", CPU_INFO.read_text(), re.MULTILINE)
    except OSError:  # another system
        return None
    return found[1] if found else None
