"""The tables of a report, and the facts of its data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from photonfarm.core.archives import Seconds
from photonfarm.core.formatting import format_bytes, format_count, format_milliseconds
from photonfarm.core.page import Table
from photonfarm.trainer.compare.evaluation_page import METRICS, describe_device, list_notes, make_table
from photonfarm.trainer.metrics.image_metrics import HEADLINE, NOT_AVAILABLE, format_with_interval
from photonfarm.trainer.predictors.evaluation import TIMED_ROUNDS
from photonfarm.trainer.report.contents import Published, ReportContents, ReportEntry


def make_tables(contents: ReportContents) -> list[Table]:
    """All tables, in the order of the report."""
    tables = [
        _make_paper_table(contents),
        _make_error_table(contents),
        _make_frame_table(contents),
        _make_run_table(contents),
        _make_worst_table(contents),
    ]
    return [table.drop_empty_columns() for table in tables if table.rows]


PAPER: dict[str, tuple[str, int, Callable[[Published], str]]] = {
    "mse": ("MSE (95 %)", 5, lambda paper: f"{paper.mse:.4f}"),
    "mssim": ("MSSIM (95 %)", 3, lambda paper: f"{paper.mssim:.3f}"),
    "fid": ("FID", 1, lambda paper: f"{paper.fid:.1f}"),
    HEADLINE: ("Feature L1 (95 %)", 3, lambda paper: f"{paper.feature_l1:.3f}"),
}
"""The metrics of Tables 1 and 2: head, digits, and the published figure."""


def _make_paper_table(contents: ReportContents) -> Table:
    """Tables 1 and 2: time per frame, MSE, MSSIM, FID, Feature L1; with the published figures, if there are any."""
    unit, entries = contents.measure, contents.entries
    head = ["architecture", "time per frame, ms"]
    rows = [[entry.name, format_milliseconds(entry.time.total) if entry.time else NOT_AVAILABLE] for entry in entries]

    def add_column(title: str, ours: Callable[[ReportEntry], str], theirs: Callable[[Published], str]) -> None:
        head.append(title)
        for row, entry in zip(rows, entries, strict=True):
            row.append(ours(entry))
        if contents.published:
            head.append("paper")
            for row, entry in zip(rows, entries, strict=True):
                row.append(theirs(entry.published) if entry.published else "")

    if len(entries) > 1:
        add_column(
            f"× {unit.name}",
            lambda entry: f"{entry.time.total / unit.time.total:.2f}" if entry.time and unit.time else NOT_AVAILABLE,
            lambda paper: f"{paper.seconds / unit.published.seconds:.2f}" if unit.published else "",
        )
    for name, (title, digits, theirs) in PAPER.items() if _has_references(contents) else ():
        add_column(title, partial(_format_metric, name=name, digits=digits), theirs)
    notes = [_describe_time(contents), *list_notes(contents.evaluation)[1:]]
    if contents.published:
        notes.append(
            "“paper” are the published figures, of four other rooms' average at 256² with networks of width 64 on "
            "another machine: orders of errors and ratios of networks' times can be compared, values cannot; "
            "denoisers' times are mostly rendering, of another number of samples per pixel"
        )
    return Table(f"The paper's columns{f': {contents.published}' if contents.published else ''}", head, rows, notes)


def _format_metric(entry: ReportEntry, name: str, digits: int) -> str:
    return format_with_interval(entry.estimates.get(name), digits)


def _has_references(contents: ReportContents) -> bool:
    return any(entry.row.metrics is not None for entry in contents.entries)


def _describe_time(contents: ReportContents) -> str:
    if contents.costs is None:
        return f"time per frame: n/a, as {contents.untimed}"
    frames, edit = len(contents.costs.edit_s), contents.costs.parts()["edit_s"]
    return (
        f"time per frame: medians of {frames} frames for rendering, buffers, points and photons, on one core by LLVM's "
        f"code; of {TIMED_ROUNDS} calls, taken by turns, for networks, on {describe_device(contents.evaluation)}; "
        f"editing the scene, {_format_times(edit)} ms, which all need, is not in it"
    )


def _make_error_table(contents: ReportContents) -> Table:
    """The linear error, and the metrics that the paper does not have."""
    others = {name: column for name, column in METRICS.items() if name not in PAPER}
    table = make_table(contents.evaluation, others)
    rows = [[entry.name, *row[1:]] for entry, row in zip(contents.entries, table.rows, strict=True)]
    return replace(table, title="Linear error and further metrics", rows=rows, notes=table.notes[:2])


def _make_frame_table(contents: ReportContents) -> Table:
    rows = [
        [
            entry.name,
            *(_format_times(part) if part else "–" for part in entry.time.parts.values()),
            format_milliseconds(entry.time.total),
        ]
        for entry in contents.entries
        if entry.time
    ]
    head = ["architecture", "render 1/k", "buffers", "guides", "points seen", "photons", "network", "all"]
    return Table(
        "Where the time of a frame goes", head, rows, ["milliseconds: the median, and the middle 80 % of the times"]
    )


def _format_times(time: Seconds) -> str:
    low, high = format_milliseconds(time.low), format_milliseconds(time.high)
    return f"{format_milliseconds(time.median)} ({low} … {high})"


def _make_run_table(contents: ReportContents) -> Table:
    rows = []
    for of in (story.document() for story in contents.stories):
        row = [of["name"], f"{of['parameters']:,}", f"{of['steps']}", f"{of['draws_per_sample']:.1f}"]
        row += [f"{of['seconds']['train'] / 60:.1f}", f"{of['waits']['samples']:.1%}", f"{of['waits']['reading']:.1%}"]
        rows.append([*row, f"{of['samples_per_used']:.2f}", of["bottleneck"]])
    head = ["run", "parameters", "steps", "draws per sample", "minutes of steps", "waited for samples", "for reading"]
    notes = [f"{story.name}: {story.advice.sentence}" for story in contents.stories if story.advice]
    return Table("Training", [*head, "samples there for each used (--ahead)", "bottleneck"], rows, notes)


def _make_worst_table(contents: ReportContents) -> Table:
    rows = [[case.kind, f"{case.row}", f"{case.pixels:.1%}", f"{case.mse:.4f}"] for case in contents.worst]
    note = (
        f"of all views with references, those in which pixels of one kind cost {contents.entries[0].name} most: the "
        "sum of their squared error in the metric space, the references' noise taken out. Near surfaces: the nearest "
        "5 % of what is seen. Fine shadows: in both halves of the reference light steps where nothing else does"
    )
    return Table("Worst cases", ["kind of pixels", "row of the store", "of the image", "MSE there"], rows, [note])


# -------------------------------------------------------------------------------------------------- the dataset's card


def list_facts(contents: ReportContents) -> list[tuple[str, str]]:
    """The dataset's card: names and values."""
    card, spec = contents.card, contents.card.spec
    t, owed, further = spec.transport, spec.credits, card.further_passes
    versions = ", ".join(f"{package} {' and '.join(numbers)}" for package, numbers in card.versions.items())
    settings = t.model_dump(exclude={"half_spp"}, exclude_defaults=True)
    trained = sorted({story.run.settings.seed for story in contents.stories})
    passes = cost = ""
    if further.rows:
        passes = f"; and {further.rows} further passes of their views, as references need"
        cost = f"; {further.core_seconds:.0f} more of further passes"
    return [
        ("scene", f"{spec.name}, {card.source}, id {spec.scene_id}"),
        ("credits", "not said" if owed is None else f"“{owed.title}” by {owed.author}, {owed.licence}"),
        *([("published at", owed.source)] if owed is not None and owed.source else []),
        ("kind", card.kind),
        ("images", f"{spec.film.width} × {spec.film.height}, exposure {spec.exposure:g}"),
        (
            "samples",
            f"{card.samples.rows} of {card.samples.planned} planned, {2 * t.half_spp} samples per pixel each, "
            f"in two independent halves{passes}",
        ),
        ("noise of the targets", f"{contents.evaluation.noise_floor:.4g}, of those held out, as linear MSE"),
        (
            "transport",
            f"bdpt: paths of up to {t.max_depth} edges, {format_count(t.connections, 'connection')}, light ratio "
            f"{t.light_ratio:g}{f'; not by default: {_format_pairs(settings)}' if settings else ''}",
        ),
        ("points, photons", f"{spec.points} points; {spec.photons.paths} light paths of {spec.photons.depth} edges"),
        *((f"plan {number}", _format_pairs(request)) for number, request in enumerate(card.requests)),
        ("seeds of training", ", ".join(map(str, trained))),
        (
            "cost",
            f"{card.samples.core_seconds:.0f} core-seconds, {1e3 * card.core_s_per_sample:.0f} ms a sample{cost}; "
            f"{card.status.redrawn} renders drawn again, as they were not finite",
        ),
        ("size", format_bytes(card.status.size_bytes)),
        ("rendered by", f"{format_count(card.workers, 'worker')} with {versions}"),
        ("times taken on", contents.machine.sentence),
        ("trained on", "; ".join(f"{story.name}: {'a GPU' if story.on_gpu else 'CPUs'}" for story in contents.stories)),
    ]


def _format_pairs(values: dict[str, object]) -> str:
    """Keys and values of a request or of settings, but for those that say nothing."""
    return ", ".join(f"{key} {value}" for key, value in values.items() if value not in (None, (), [], ""))
