"""An experiment's report as the tables read it, and what it was measured on: how, at what cost, at which commits."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from experiments.experiment import Experiment, name_halves, name_seeded
from experiments.stages import EVALUATION, PATHS
from photonfarm.core.errors import IncompleteError, SpecError
from photonfarm.core.formatting import format_markdown_table
from photonfarm.core.statistics import Estimate
from photonfarm.trainer.metrics.image_metrics import HEADLINE_BLOCK, NOT_AVAILABLE

HEADLINE_FEATURE = f"feature_l1_{HEADLINE_BLOCK}"
"""The key of the mean of Feature L1 in a row."""

DIGITS = 5  # of what is kept of a report


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """An experiment and what tables.json keeps of its report."""

    experiment: Experiment
    document: dict[str, Any]

    @classmethod
    def read(cls, experiment: Experiment, file: Path, commit: str) -> Self:
        """Read a room from its report.json, at a commit. Raises IncompleteError if further seeds were not measured."""
        room = cls.of(experiment, json.loads(file.read_text(encoding="utf-8")), commit)
        if (paths := file.parents[1] / PATHS).is_file():
            room.rows.update(json.loads(paths.read_text(encoding="utf-8")))
        if again := experiment.again():
            evaluated = file.parents[1] / "runs" / again[0].name / EVALUATION
            room.document["further_seeds"] = _read_further_seeds(experiment, evaluated)
        return room

    @classmethod
    def of(cls, experiment: Experiment, report: Mapping[str, Any], commit: str) -> Self:
        """A room with what is kept of a report, and the commit at which that was read."""
        evaluation = report["evaluation"]
        of_all = ("samples", "units", "noise_floor", "references", "device", "threads")
        of_run = ("architecture", "parameters", "steps", "trained_on", "seconds")
        settings = ("max_steps", "batch", "layer_rates")
        document = {
            "title": experiment.title,
            "about": experiment.about.strip(),
            "size": experiment.size.about,
            "commit": commit,
            "trained_at": report.get("trained_at", {}),
            "machine": report["machine"],
            "dataset": report["dataset"],
            "evaluation": {key: evaluation[key] for key in of_all},
            "edit_seconds": report["edit_seconds"],
            "runs": {
                run["name"]: {key: run[key] for key in of_run}
                | {"settings": {key: run["settings"][key] for key in settings if key in run["settings"]}}
                for run in report["runs"]
            },
            "rows": {row["name"]: _compact(row) for row in evaluation["rows"]},
        }
        return cls(experiment, document)

    @property
    def name(self) -> str:
        """The name of the experiment."""
        return self.experiment.name

    @property
    def rows(self) -> dict[str, dict[str, Any]]:
        """Those of its evaluation, by name."""
        return self.document["rows"]

    @property
    def film(self) -> tuple[int, int]:
        """Width and height of its images."""
        card = self.document["dataset"]
        return card["width"], card["height"]

    @property
    def paper_film(self) -> tuple[int, int]:
        """Width and height of the paper's images of such a scene."""
        film = Experiment.load(self.name, "paper").size.changes["film"]
        return film["width"], film["height"]

    @property
    def device(self) -> str:
        """What its networks ran on, as torch names it."""
        return str(self.document["evaluation"]["device"])

    def machine(self) -> str:
        """What it was timed on."""
        machine = self.document["machine"]
        return f"{machine['cpu'] or 'a CPU of unknown model'}, {machine['cores']} cores, {machine['architecture']}"

    def commits(self) -> list[str]:
        """The commits at which its networks were trained; none where that was not recorded."""
        by_run: dict[str, list[str]] = self.document.get("trained_at", {})
        return list(dict.fromkeys(commit for of_run in by_run.values() for commit in of_run))

    def spent(self, kind: str) -> dict[str, Any]:
        """Rows and core-seconds of a kind of plan, "samples" or "top-up"."""
        totals: dict[str, Any] = self.document["dataset"]["spent"].get(kind, {"rows": 0, "core_seconds": 0.0})
        return totals

    def layer_rates(self) -> str:
        """The rates of its networks' layers, in words; reports of before these could be set have equal ones."""
        told = {run["settings"].get("layer_rates", "equal") for run in self.document["runs"].values()}
        return " or ".join(f"{rates} rates of layers" for rates in sorted(told))

    @property
    def has_free_space(self) -> bool:
        """Whether its cameras were kept out of furniture and walls; reports of before that do not say so."""
        return bool(self.document["dataset"].get("free_space", False))

    def time_ratio(self, name: str) -> float | None:
        """Seconds of a row's frame over those of light_transport's; None where either was not timed."""
        unit = self.rows.get("light_transport")
        own, of_unit = self.rows[name]["frame_seconds"], unit and unit["frame_seconds"]
        return own["total"] / of_unit["total"] if own and of_unit else None

    def errors(self, name: str) -> NDArray[np.float64] | None:
        """MSE of a row's images, (seeds, views); None where it has none.

        Raises SpecError where a configuration has several views, which are not independent.
        """
        row = self.rows.get(name)
        if row is None or "mse" not in row:
            return None
        count, views = row["mse"]["count"], len(row["mse_of_images"])
        if count != views:
            raise SpecError(
                f"{self.name}: its {views} views are of {count} configurations; gaps are taken in pairs of views, "
                "which are independent only where each configuration has one: set views = 1"
            )
        return np.array([row["mse_of_images"], *self.document.get("further_seeds", {}).get(name, ())])

    def mse(self, name: str) -> Estimate | None:
        """MSE of a row over its views, the mean of its seeds; None where it has none. Raises SpecError as `errors`."""
        errors = self.errors(name)
        return None if errors is None else Estimate.of(errors.mean(axis=0))

    def gap(self, first: str, second: str) -> Gap | None:
        """How far the first's MSE is above the second's; None where either has none. Raises SpecError as `errors`."""
        pair = [self.errors(name) for name in (first, second)]
        both = [errors for errors in pair if errors is not None]
        if len(both) < len(pair):
            return None
        seeds = min(len(errors) for errors in both)
        differences = both[0][:seeds] - both[1][:seeds]
        unit = float(both[0].mean())
        return Gap(Estimate.of(differences.mean(axis=0)), unit, tuple((differences.mean(axis=1) / unit).tolist()))


@dataclass(frozen=True, slots=True)
class Gap:
    """How far one network's MSE is above another's, in pairs of views."""

    difference: Estimate  # the mean of all seeds
    unit: float  # the first's MSE
    of_seeds: tuple[float, ...]  # each seed's difference as a share of the unit


def read_estimate(row: Mapping[str, Any], metric: str) -> Estimate | None:
    """Mean and standard error of a metric that each image has; None where it could not be computed."""
    values = row.get(metric)
    return None if values is None else Estimate(**values)


def _read_further_seeds(experiment: Experiment, file: Path) -> dict[str, list[list[float]]]:
    """MSE of each image by each further seed, of each network's rows.

    Raises IncompleteError where they were not measured, or others were.
    """
    remedy = f"`python experiments/run.py {experiment.name}` makes it"
    if not file.is_file():
        raise IncompleteError(f"{file}: not there; {remedy}")
    rows = json.loads(file.read_text(encoding="utf-8"))["rows"]  # the runs, then those of several halves run by run
    again, several = experiment.again(), experiment.size.halves
    names = [run.name for run in again]
    names += [name_halves(run.name, halves) for run in again if run.is_given_halves for halves in several]
    if len(rows) not in (len(again), len(names)):
        raise IncompleteError(f"{file}: is of {len(rows)} rows, and the experiment has {len(names)}; {remedy} anew")
    errors = {name: row["metric_space"]["mse"]["values"] for name, row in zip(names, rows, strict=False)}
    by_row: dict[str, list[list[float]]] = {}
    for run in experiment.trained():
        for halves in (1, *several):
            names = [name_halves(name_seeded(run.name, seed), halves) for seed in run.further]
            values = [[round(value, 6) for value in errors[name]] for name in names if name in errors]
            by_row[name_halves(run.name, halves)] = values
    return {name: values for name, values in by_row.items() if values}


def _compact(row: Mapping[str, Any]) -> dict[str, Any]:
    """Times, mean and interval of each metric, and the MSE of each image."""
    shown, parts = row["metric_space"], row["frame_seconds"]
    told = {
        "frame_seconds": parts and {part: time for part, time in parts.items() if part != "ranges"},
        "network_seconds": row["network_seconds"],
        "network_seconds_range": row["network_seconds_range"],
    }
    if shown is not None:
        told |= {key: shown[key]["estimate"] for key in ("mse", "mssim")}
        if features := shown["feature_l1"]:
            told[HEADLINE_FEATURE] = features[HEADLINE_BLOCK]["estimate"]
        told |= {"fid": shown["fid"] and {"value": shown["fid"]["value"]}, "kid": shown["kid"]}
        told["mse_of_images"] = [round(value, 6) for value in shown["mse"]["values"]]
    rounded: dict[str, Any] = _round(told)
    return rounded


def _round(told: Any) -> Any:
    """The same with DIGITS digits of each number that is not whole."""
    if isinstance(told, Mapping):
        return {key: _round(value) for key, value in told.items()}
    if isinstance(told, (list, tuple)):
        return [_round(value) for value in told]
    return float(f"{told:.{DIGITS}g}") if isinstance(told, float) else told


# --------------------------------------------------------------------------------------------------- what was measured

WIDTH = 120  # characters of a line


def format_rooms(rooms: Sequence[Room]) -> str:
    """The images of each room, and how they were rendered."""
    head = (
        "experiment",
        "images trained on",
        "held out",
        "spp",
        "references",
        "noise of targets, linear MSE",
        "connections",
        "light ratio",
        "light samples",
    )
    return format_markdown_table(head, [_describe_rendering(room) for room in rooms])


def _describe_rendering(room: Room) -> list[str]:
    card, evaluation = room.document["dataset"], room.document["evaluation"]
    trained_on = sorted({run["trained_on"] for run in room.document["runs"].values()})
    images, references, guides = room.spent("samples"), evaluation["references"], card.get("guides")
    return [
        room.name,
        " or ".join(map(str, trained_on)),
        " or ".join(f"{images['rows'] - count}" for count in reversed(trained_on)),
        f"{card['spp_per_sample']}",
        f"{references['views']} views, {references['spp']} spp" if references else NOT_AVAILABLE,
        f"{evaluation['noise_floor']:.3g}",
        f"{card['transport']['connections']}",
        f"{card['transport']['light_ratio']:g}",
        f"{guides['light_samples']}" if guides else NOT_AVAILABLE,
    ]


def format_costs(rooms: Sequence[Room]) -> str:
    """What each room took, and whether the machine was quiet."""
    head = (
        "experiment",
        "images, core-s",
        "reference passes",
        "passes, core-s",
        "MB in all",
        "edit, ms",
        "load average of 1, 5, 15 min",
    )
    return format_markdown_table(head, [_describe_cost(room) for room in rooms])


def _describe_cost(room: Room) -> list[str]:
    images, passes, edit = room.spent("samples"), room.spent("top-up"), room.document["edit_seconds"]
    return [
        room.name,
        f"{images['core_seconds']:.0f}",
        f"{passes['rows']}",
        f"{passes['core_seconds']:.0f}",
        f"{room.document['dataset']['bytes'] / 1e6:.0f}",
        NOT_AVAILABLE if edit is None else f"{1e3 * edit:.0f}",
        ", ".join(f"{average:.1f}" for average in room.document["machine"]["load_average"]),
    ]


def format_descriptions(rooms: Sequence[Room]) -> str:
    """A list of the rooms: what moves, why they are rendered so, who is credited for them, and commits."""
    return "\n".join(wrap(_describe(room), "- ", "  ") for room in rooms)


def _describe(room: Room) -> str:
    document, owed = room.document, room.document["dataset"]["credits"]
    scene = "" if owed is None else f" Scene: “{owed['title']}” by {owed['author']}, {owed['licence']}."
    commits = ", ".join(room.commits())
    trained = f"Trained at commit {commits}" if commits else "At which commit it was trained was not recorded"
    return (
        f"**{room.name}** ({document['title']}): {document['about']}{scene} {trained}; its report was "
        f"read at commit {document['commit']}."
    )


def summarise(rooms: Sequence[Room], of: Callable[[Room], str]) -> str:
    """What holds of most rooms, and then what holds of the others, with their names."""
    rooms_by_text: dict[str, list[str]] = {}
    for room in rooms:
        rooms_by_text.setdefault(of(room), []).append(room.name)
    most = max(rooms_by_text, key=lambda what: len(rooms_by_text[what]))
    others = [f"{', '.join(which)}: {what}" for what, which in rooms_by_text.items() if what != most]
    return f"{most} ({'; '.join(others)})" if others else most


def wrap(text: str, first: str = "", others: str = "") -> str:
    """A paragraph in lines of at most WIDTH characters after `first` and `others`; code and links are not broken."""
    whole = re.sub(r"`[^`]*`|\[[^\]]*\]", lambda match: match[0].replace(" ", "\0"), text)
    filled = textwrap.fill(
        whole, WIDTH, initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )
    return filled.replace("\0", " ")
