"""The grid search over optimisers, rates and decays [supplement 3.1]: short runs that differ in nothing else.

    python -m bench.trainer.grid_search [SPEC] [--store DIR|URL] [--run DIR] [--preset NAME] [--steps N] …

It takes the options of `photonfarm train` that set something; `--steps` is 1000 by default. The store must be complete.
What an option sets is not searched, nor is a decay that would not act. The same command continues a search that was
stopped. The table is printed, and grid.md and grid.json are left in the folder `--run`, beside a folder for each run.

A cell is one combination of the axes. All cells use the same samples in the same order from the same first weights and
are measured on the same held-out samples, so that they are compared in pairs. The best of many cells looks better than
it is on the samples that selected it; so it is selected by one half of the held-out configurations, and the reported
errors are those on the other half.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import click
import numpy as np
from pydantic import ValidationError

from photonfarm.core.errors import IncompleteError, PhotonfarmError, SpecError, StoreError, store_errors
from photonfarm.core.files import write_whole
from photonfarm.core.formatting import format_markdown_table
from photonfarm.core.keys import Key, make_key
from photonfarm.core.models import sentences
from photonfarm.core.processes import Stop
from photonfarm.core.statistics import Estimate, format_estimate, group_means
from photonfarm.plan.hold_out import rows_held_out, units_of
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.cli.train_verb import collect_settings
from photonfarm.trainer.cli.train_verb import train as train_verb
from photonfarm.trainer.data.feed import Feed, SampleSource
from photonfarm.trainer.predictors.evaluation import HeldOutErrors, measure, read_batches
from photonfarm.trainer.predictors.trained import TrainedRun
from photonfarm.trainer.runs.run_folder import lock_run
from photonfarm.trainer.runs.settings import MOST_HELD_OUT, TrainSettings, make_settings
from photonfarm.trainer.training.learner import DivergedError
from photonfarm.trainer.training.loop import Hooks, stop_on_signals, train

Axes = Mapping[str, Sequence[Any]]
"""The values of each searched key of the settings."""

AXES: Axes = {
    "optimiser": ("adam", "rmsprop"),
    "learning_rate": (1e-4, 5e-4, 1e-3, 2e-3),
    "decay": (0.95, 0.99, 1.0),
}
"""The keys that the supplement searched; it does not give the values, and these are ours, around those it chose."""

STEPS = 1000
"""The default number of steps of a cell."""

JSON = "grid.json"
MARKDOWN = "grid.md"


@dataclass(frozen=True, slots=True)
class Cell:
    """The result of one combination."""

    changes: dict[str, Any]  # the axes' values
    picked_by: tuple[float, ...]  # held-out error of each configuration of one half, noise removed; and of…
    per_unit: tuple[float, ...]  # …each one of the other half, which selected nothing; empty: training diverged

    @property
    def rank(self) -> float:
        """The value that ranks cells, least first: the mean error on the first half; infinite if training diverged."""
        return float(np.mean(self.picked_by)) if self.picked_by else math.inf

    @property
    def error(self) -> Estimate | None:
        """The error over the configurations of the second half; None if training diverged."""
        return Estimate.of(np.array(self.per_unit)) if self.per_unit else None

    def behind(self, best: Cell) -> Estimate:
        """The excess of that error over another cell's: the mean over pairs, one for each configuration."""
        return Estimate.of(np.array(self.per_unit) - np.array(best.per_unit))


def run_grid(
    make_source: Callable[[], SampleSource],
    settings: TrainSettings,
    folder: Path,
    axes: Axes = AXES,
    *,
    stop: Stop | None = None,
    log: Callable[[str], object] = lambda _: None,
) -> list[Cell]:
    """Train and measure every cell; returns the finished ones, which are all unless `stop` was set.

    Each cell is a run in a folder of its own below `folder`, where grid.json and grid.md grow with every cell. Finished
    cells are not trained again, and an unfinished one resumes from its last checkpoint; grid.json also keeps cells of
    other values of the axes. `make_source` opens the same complete samples each time; `log` gets a line for every
    cell, and whom a cell waits for. Raises IncompleteError while samples are missing and if fewer than two
    configurations are held out; SpecError for an axis that the settings do not have, and for a folder that holds a grid
    over other samples or settings; and the errors of a run, except DivergedError.
    """
    stop = stop or Stop()
    wanted = _cells(settings, axes)
    equal = {key: value for key, value in settings.model_dump(mode="json").items() if key not in axes}
    about = {**_about(make_source(), settings), "settings": equal}
    with lock_run(folder):
        known = _read(folder / JSON, about)
        finished = [cell for cell in known if any(cell.changes == changes for changes, _ in wanted)]
        for changes, changed in wanted:
            if any(cell.changes == changes for cell in finished):
                continue
            cell = _run_cell(make_source, changed, changes, folder / _name(changes), stop, log)
            if cell is None:
                break
            known.append(cell)
            finished.append(cell)
            _write(folder, about, known, finished)
            log(f"{len(finished)} of {len(wanted)}: {_name(changes)}: {_stated(cell.error)}")
        _write(folder, about, known, finished)
    return finished


def table(cells: Sequence[Cell]) -> str:
    """The cells as a Markdown table, the best first; differences from it are of pairs of configurations."""
    ranked = sorted(cells, key=lambda cell: cell.rank)
    keys = list(cells[0].changes) if cells else []
    rows = []
    for cell in ranked:
        behind = _stated(cell.behind(ranked[0])) if cell.per_unit and cell is not ranked[0] else ""
        picked = format_estimate(cell.rank, None) if cell.picked_by else ""
        rows.append([*map(str, cell.changes.values()), picked, _stated(cell.error), behind])
    return format_markdown_table([*keys, "picked by", "held-out error", "more than the best"], rows)


def _cells(settings: TrainSettings, axes: Axes) -> list[tuple[dict[str, Any], TrainSettings]]:
    """Every combination of the axes, with its settings."""
    try:
        combinations = [dict(zip(axes, values, strict=True)) for values in product(*axes.values())]
        return [(c, TrainSettings.model_validate({**settings.model_dump(), **c})) for c in combinations]
    except ValidationError as error:
        raise SpecError(f"the axes of the grid: {'; '.join(sentences(error))}") from error


def _about(source: SampleSource, settings: TrainSettings) -> dict[str, Any]:
    """The properties that all cells share: scene and number of samples; IncompleteError if there are too few."""
    if not source.ready():
        raise IncompleteError("the scene has no samples yet; a grid compares runs over samples that are there")
    rows = source.refresh().tolist()
    if len(rows) < source.planned:
        raise IncompleteError(
            f"{len(rows)} of {source.planned} planned samples are complete; "
            "a grid compares runs over the same samples: wait for the workers"
        )
    sides = zip(rows, rows_held_out(source, rows, settings.hold_out), strict=True)
    held_out = [row for row, is_held_out in sides if is_held_out][:MOST_HELD_OUT]
    if len(set(units_of(source, held_out))) < 2:
        raise IncompleteError(
            f"hold_out = {settings.hold_out:g}: holds out fewer than two configurations, and a grid needs one to pick "
            "the best by and another to say how good that is; raise it, or plan more"
        )
    return {"scene_id": source.spec.scene_id, "samples": len(rows)}


def _name(changes: Mapping[str, Any]) -> str:
    """The name of a cell's folder."""
    return "-".join(str(value) for value in changes.values())


def _stated(estimate: Estimate | None) -> str:
    return "diverged" if estimate is None else format_estimate(estimate.mean, estimate.standard_error)


# ------------------------------------------------------------------------------------------------------------- one cell


def _run_cell(
    make_source: Callable[[], SampleSource],
    settings: TrainSettings,
    changes: dict[str, Any],
    run: Path,
    stop: Stop,
    log: Callable[[str], object],
) -> Cell | None:
    """Train a cell to its end and measure it; None if it was stopped early."""
    try:
        if train(make_source(), settings, run, Hooks(stop=stop, on_wait=log)).reason == "stopped":
            return None
    except DivergedError:
        return Cell(changes, (), ())
    picked_by, per_unit = _halves(_held_out(make_source(), settings, run))
    return Cell(changes, picked_by, per_unit) if np.isfinite([*picked_by, *per_unit]).all() else Cell(changes, (), ())


def _held_out(source: SampleSource, settings: TrainSettings, run: Path) -> HeldOutErrors:
    """The held-out error of a run's last network."""
    with Feed(source, settings) as feed:
        arrived, _ = feed.arrivals()
        rows = [row for row, is_held_out in arrived if is_held_out][:MOST_HELD_OUT]
        predict = TrainedRun.load(run).predictor(feed.spec, (feed.geometry, feed.cloud), settings.device)
        return measure(predict, read_batches(feed, rows, settings.batch))


def _halves(found: HeldOutErrors) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The errors of the configurations, in two halves by a hash of their keys; the second has the odd one."""
    errors = group_means(found.per_sample, found.units).tolist()
    ordered = sorted(zip(map(_place, dict.fromkeys(found.units)), errors, strict=True))
    values = tuple(error for _, error in ordered)
    return values[: len(values) // 2], values[len(values) // 2 :]


def _place(unit: Key) -> Key:
    """The key that orders the configurations, independent of the hash by which they are held out."""
    return make_key("half of a grid", unit)


# ---------------------------------------------------------------------------------------------------------------- files


def _read(path: Path, about: Mapping[str, Any]) -> list[Cell]:
    """The finished cells of a grid; SpecError if it has other properties, StoreError if it cannot be read."""
    if not path.exists():
        return []
    with store_errors("read the grid", path):
        text = path.read_text()
    try:
        written = json.loads(text)
        cells = [Cell(cell["changes"], tuple(cell["picked_by"]), tuple(cell["per_unit"])) for cell in written["cells"]]
        before, now = ({**document, **document["settings"]} for document in (written, about))
    except (ValueError, LookupError, TypeError) as error:
        raise StoreError(f"{path}: is not a list of grid results; remove it, and the grid begins anew") from error
    for key in now:
        if key != "settings" and before.get(key) != now[key]:
            raise SpecError(f"{path}: has {key} = {before.get(key)!r}, now {now[key]!r}; use another run folder")
    return cells


def _write(folder: Path, about: Mapping[str, Any], known: Sequence[Cell], wanted: Sequence[Cell]) -> None:
    """Write grid.json, of all known cells, and grid.md, of the wanted ones, each whole or not at all."""
    described = [{**asdict(cell), **(asdict(cell.error) if cell.error else {})} for cell in known]
    document = json.dumps({**about, "cells": described}, indent=2)
    with store_errors("write the grid", folder):
        for name, text in ((JSON, document), (MARKDOWN, table(wanted))):
            write_whole(folder / name, text + "\n")


# -------------------------------------------------------------------------------------------------------- command line

NOT_SET = ("redis_url", "until_complete", "summary", "check", "dry_run", "film", "as_json")
"""The options of `photonfarm train` that are not about the settings of a run."""


def search(
    spec: str | None,
    store: str | Path,
    folder: Path,
    preset_name: str,
    changes: Mapping[str, Any],
    log: Callable[[str], object],
) -> str:
    """Run, or resume, the search on a scene of a store; returns its table. Keys that `changes` sets are not searched.

    Raises SpecError without a spec, unless the store has one scene; StoreError without that store or scene; and the
    errors of `run_grid`.
    """
    settings = make_settings(preset_name, {"max_steps": STEPS, "recover": False, **changes})  # each rate as it is
    scenes = Store(store).scenes(load_spec(spec).scene_id if spec else None)
    if len(scenes) != 1:
        raise SpecError(f"{store}: holds {len(scenes)} scenes; name the spec of the one to train on")
    axes = {key: (changes[key],) if key in changes else values for key, values in AXES.items()}
    if settings.schedule == "cosine":
        axes["decay"] = (settings.decay,)
        log("decay is not searched: schedule = 'cosine' has none")
    elif (drawn := settings.max_steps * settings.batch) <= settings.epoch_samples:
        axes["decay"] = (settings.decay,)
        log(f"decay is not searched: it begins after {settings.epoch_samples} samples, and {drawn} are drawn")
    with stop_on_signals() as stop:
        cells = run_grid(lambda: SceneReader(store, scenes[0].scene_id), settings, folder, axes, stop=stop, log=log)
    if stop.is_set():
        log(f"stopped after {len(cells)} cells; the same command goes on")
    return table(cells)


@click.command(help=__doc__, params=[option for option in train_verb.params if option.name not in NOT_SET])
def main(spec: str | None, store: str | Path, run: Path, preset: str, pairs: tuple[str, ...], **options: Any) -> None:
    changes = {**collect_settings(pairs), **{key: value for key, value in options.items() if value is not None}}
    try:
        click.echo(search(spec, store, run, preset, changes, lambda sentence: click.echo(sentence, err=True)))
    except PhotonfarmError as error:
        click.echo(f"grid_search: {error}", err=True)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
