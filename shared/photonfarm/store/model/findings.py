"""What `photonfarm store check` can find, and its findings: grouped by cause, the first of each kept by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

NAMED = 5
"""The findings of one cause that a report lists; the rest is counted."""

REASONS = 20
"""The findings of one job that its quarantine record lists."""

MISSING = (
    "the plan is missing, or its zarr.json is; it says what the rows of its jobs are, and cannot be made anew: put the "
    "folder back from a copy of the store"
)
"""The message about a missing plan."""

RESTORE = "put the plan's small files (zarr.json, and the inputs) back from a copy of the store"
"""The remedy for a plan whose request cannot be read."""

REWRITE = "`photonfarm store check --repair` writes the inputs of a plan again from its request"
"""The remedy for most damage of a plan."""


def rejoin(store_id: str) -> str:
    """The remedy for damaged inputs of a plan of a join."""
    return (
        "`photonfarm store check --repair --joined-from OTHER` writes the inputs of the plan again from the store that "
        f"it was joined from, of the id {store_id}"
    )


SET_ASIDE = "`photonfarm store check --repair` sets it aside, and `photonfarm submit` of the same spec writes it again"
"""The remedy for a damaged spec."""

BASE_ASIDE = "`photonfarm store check --repair` sets it aside, and the next job that a worker renders writes it again"
"""The remedy for a damaged base."""


class Remedy(Enum):
    """The remedies for causes."""

    RENDER = "render again"  # the job is set aside, and workers find it missing
    BASE = "write the base again"  # it is set aside, and the next job writes it
    SUBMIT = "submit the spec again"  # it is set aside, and written by the next submission
    REWRITE = "write it again from the plan's request"  # by --repair, at once; what was there is set aside
    REPORT = "cannot be repaired here"
    LOOK = "may be right: worth a look"  # no error, and no exit code


class Cause(Enum):
    """The causes of findings: the name in JSON, the sentence, and the remedy."""

    MARKER = "marker", "a marker that cannot be read, or does not name its job's files", Remedy.RENDER
    NO_PLAN = "no-plan", "a marker of a job that no plan has", Remedy.RENDER
    MISSING_FILE = "missing-file", "committed, but a file is missing", Remedy.RENDER
    SIZE = "size", "a file has another size than its marker gives", Remedy.RENDER
    CHECKSUM = "checksum", "stored bytes are not what was committed", Remedy.RENDER
    MISSING_ROW = "missing-row", "committed, but a row is missing", Remedy.RENDER
    UNUSED_ROW = "unused-row", "a row that the plan does not use holds data", Remedy.RENDER
    NOT_FINITE = "not-finite", "a stored value is NaN or infinite", Remedy.RENDER
    UNUSED_BIT = (
        "unused-bit",
        "a bit says that a point or photon is seen that the scene does not have",
        Remedy.RENDER,
    )
    EQUAL_HALVES = "equal-halves", "halves A and B of a sample are equal: one seed, used twice", Remedy.RENDER
    EQUAL_SAMPLES = "equal-samples", "halves of different samples are equal: one seed, used twice", Remedy.RENDER
    SAME_AGAIN = (
        "same-again",
        "halves are equal, and came out the same when their job was set aside and rendered again: without noise?",
        Remedy.LOOK,
    )
    SAME_SEED = (
        "same-seed",
        "halves of different samples are equal: their keys happen to give one seed, and would give it again",
        Remedy.LOOK,
    )
    HALVES_DIFFER = "halves-differ", "A and B are not distributed alike: one of them is biased", Remedy.REPORT
    UNREADABLE = (
        "unreadable",
        "cannot be read: disk, rights or server refuse it; what it holds may be whole",
        Remedy.REPORT,
    )
    SPEC = "spec", "the scene's spec is missing or not what was stored", Remedy.SUBMIT
    PLAN = (
        "plan",
        "a plan is not what was stored, and its request does not give it: put its small files back from a backup; what "
        "is rendered stays, checked by its markers",
        Remedy.REPORT,
    )
    LEFT = (
        "left-in-place",
        "a damaged job that --repair leaves: while a plan of its scene cannot be read, nobody can render it again",
        Remedy.REPORT,
    )
    PLAN_INPUTS = (
        "plan-inputs",
        "an input of a plan, or the declaration of an output, is not what was stored",
        Remedy.REWRITE,
    )
    BASE = "base", "geometry or base point cloud are not what was stored", Remedy.BASE
    BASE_TO_COME = (
        "base-to-come",
        "geometry and base point cloud are not there: the next job that a worker renders writes them",
        Remedy.LOOK,
    )
    BLACK = "black", "both halves are black: no light, or the camera is inside something", Remedy.LOOK
    BLACK_HALF = (
        "black-half",
        "one half is black, and the other is not: hardly any light, or a fault of the renderer if there are many",
        Remedy.LOOK,
    )
    EMPTY_VIEW = "empty-view", "nothing is met in the whole view", Remedy.LOOK
    BACK_FACING = "back-facing", "every first hit of the view is seen from behind", Remedy.LOOK
    TWICE = (
        "twice",
        "a row is in radiance and in radiance_wide: two renders of it met, and radiance counts",
        Remedy.LOOK,
    )
    NO_MARKER = "no-marker", "files without a marker: a worker is at it, or has died", Remedy.LOOK
    FOREIGN_FILE = "foreign-file", "a file that no store writes", Remedy.LOOK

    def __init__(self, label: str, sentence: str, remedy: Remedy) -> None:
        self.label = label
        self.sentence = sentence
        self.remedy = remedy


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding of a check."""

    cause: Cause
    detail: str
    scene_id: str | None = None
    job: int | None = None
    row: int | None = None  # in the scene
    file: str | None = None  # its name in the store


@dataclass(frozen=True, slots=True)
class FindingGroup:
    """All findings of one cause."""

    cause: Cause
    count: int
    first: tuple[Finding, ...]


class Findings:
    """Collects findings; its memory grows with the number of jobs concerned, not with that of findings."""

    def __init__(self) -> None:
        self._count: Counter[Cause] = Counter()
        self._first: dict[Cause, list[Finding]] = {}
        self.jobs: dict[int, list[Finding]] = {}  # to be rendered again, each with its first reasons

    def add(self, more: Iterable[Finding]) -> None:
        """Add findings."""
        for finding in more:
            self._count[finding.cause] += 1
            _keep(self._first.setdefault(finding.cause, []), finding, NAMED)
            if finding.job is not None and finding.cause.remedy is Remedy.RENDER:
                _keep(self.jobs.setdefault(finding.job, []), finding, REASONS)

    def of(self, cause: Cause) -> list[Finding]:
        """The first findings of a cause."""
        return self._first.get(cause, [])

    def groups(self) -> tuple[FindingGroup, ...]:
        """All findings, by cause."""
        return tuple(
            FindingGroup(cause, self._count[cause], tuple(self.of(cause))) for cause in Cause if self._count[cause]
        )


def _keep(kept: list[Finding], finding: Finding, most: int) -> None:
    if len(kept) < most:
        kept.append(finding)
