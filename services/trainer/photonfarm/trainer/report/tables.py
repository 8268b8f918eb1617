"""The tables of a report as cells of text, for its page and its Markdown alike."""

from __future__ import annotations

from dataclasses import dataclass, replace

from photonfarm.core.archives import Seconds
from photonfarm.core.formatting import format_bytes, format_count, format_milliseconds
from photonfarm.core.statistics import Estimate
from photonfarm.trainer.compare.evaluation_page import describe_device, list_notes
from photonfarm.trainer.metrics import confidence_interval
from photonfarm.trainer.metrics.image_metrics import HEADLINE, NOT_AVAILABLE, TITLES
from photonfarm.trainer.predictors.evaluation import TIMED_ROUNDS
from photonfarm.trainer.report.contents import ReportContents, ReportEntry


@dataclass(frozen=True, slots=True)
class Table:
    """A table with a head; `notes` are sentences below it."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    @property
    def without_empty_columns(self) -> Table:
        """The table without the columns that say nothing in any row."""
        if not self.rows:
            return self
        kept = [place for place in range(len(self.head)) if any(row[place] not in {"", "–"} for row in self.rows)]
        rows = tuple(tuple(row[place] for place in kept) for row in self.rows)
        return replace(self, head=tuple(self.head[place] for place in kept), rows=rows)


def make_tables(contents: ReportContents) -> list[Table]:
    """All tables, in the order of the report."""
    every = [
        _make_paper_table(contents),
        _make_further_table(contents),
        *_make_frame_tables(contents),
        _make_run_table(contents),
        *_make_worst_tables(contents),
    ]
    return [table.without_empty_columns for table in every]


def list_facts(contents: ReportContents) -> list[tuple[str, str]]:
    """The dataset's card: names and values."""
    card, about = contents.card, contents.card.document()
    spec, status = card.spec, card.status
    t, owed = spec.transport, spec.credits
    versions = ", ".join(f"{package} {' and '.join(numbers)}" for package, numbers in card.versions.items())
    return [
        ("scene", f"{spec.name}, {about['source']}, id {spec.scene_id}"),
        ("credits", "not said" if owed is None else f"“{owed.title}” by {owed.author}, {owed.licence}"),
        *([("published at", owed.source)] if owed is not None and owed.source else []),
        ("kind", about["kind"]),
        ("images", f"{spec.film.width} × {spec.film.height}, exposure {spec.exposure:g}"),
        (
            "samples",
            f"{card.samples.rows} of {card.samples.planned} planned, {2 * t.half_spp} samples per pixel each, "
            f"in two independent halves{_describe_further_passes(contents)}",
        ),
        ("noise of the targets", f"{contents.evaluation.noise_floor:.4g}, of those held out, as linear MSE"),
        (
            "transport",
            f"bdpt: paths of up to {t.max_depth} edges, {format_count(t.connections, 'connection')}, light "
            f"ratio {t.light_ratio:g}"
            + ", guided light" * t.guided_light
            + (f", {t.light_samples} light samples" if t.light_samples > 1 else ""),
        ),
        ("points, photons", f"{spec.points} points; {spec.photons.paths} light paths of {spec.photons.depth} edges"),
        ("seeds", _describe_seeds(contents)),
        ("cost", _describe_cost(contents)),
        ("size", format_bytes(status.size_bytes)),
        ("rendered by", f"{format_count(card.workers, 'worker')} with {versions}"),
        ("times taken on", contents.machine.sentence),
        ("GPU", _describe_gpu_use(contents)),
    ]


def _describe_further_passes(contents: ReportContents) -> str:
    further = contents.card.further_passes
    return f"; and {further.rows} further passes of their views, as references need" if further.rows else ""


def _describe_cost(contents: ReportContents) -> str:
    card, further = contents.card, contents.card.further_passes
    spent = f"{card.samples.core_s:.0f} core-seconds, {1e3 * card.core_s_per_sample:.0f} ms a sample"
    if further.rows:
        spent += f"; {further.core_s:.0f} more of further passes, {1e3 * further.core_s / further.rows:.0f} ms each"
    return f"{spent}; {card.status.redrawn} renders drawn again, as they were not finite"


def _describe_gpu_use(contents: ReportContents) -> str:
    """The tasks that ran on a GPU."""
    trained = [story.name for story in contents.stories if story.on_gpu]
    tasks = [f"trained {', '.join(trained)}"] if trained else []
    if contents.evaluation.device != "cpu":
        tasks.append(f"networks were measured on {contents.evaluation.device}")
    return (
        "; ".join(tasks)
        if tasks
        else "none took part: images were rendered, and networks trained and measured, on CPUs"
    )


def _describe_seeds(contents: ReportContents) -> str:
    asked = []
    for number, request in enumerate(contents.card.requests):
        if request["kind"] == "samples":
            asked.append(
                f"plan {number}: seed {request['seed']}, {request['modifications']} configurations × "
                f"{request['views_per_modification']} views × {request['passes']} passes"
            )
        elif request["kind"] == "join":
            asked.append(f"plan {number}: samples of store {request['store']}, joined")
        else:
            where = f" where {' and '.join(request['where'])}" if request["where"] else ""
            asked.append(f"plan {number}: {'+' if request['adds'] else ''}{request['spp']} samples per pixel{where}")
    trained = sorted({str(story.run.settings.seed) for story in contents.stories})
    return f"{'; '.join(asked)}; training: {', '.join(trained)}"


# -------------------------------------------------------------------------------------------------- the paper's columns


def _make_paper_table(contents: ReportContents) -> Table:
    """Tables 1 and 2: time per frame, MSE, MSSIM, FID, Feature L1; with the published figures, if there are any."""
    beside = contents.published is not None
    columns = ["time per frame, ms", f"× {contents.measure.name}"]
    if _has_references(contents):
        columns += ["MSE (95 %)", "MSSIM (95 %)", "FID", "Feature L1 (95 %)"]
    head = ["architecture"]
    for column in columns:
        head.append(column)
        if beside and column != columns[0]:
            head.append("paper")
    rows = [_format_paper_row(contents, entry, beside=beside) for entry in contents.entries]
    named = f"The paper's columns: {contents.published}" if beside else "The paper's columns"
    below = [
        _describe_time(contents),
        *list_notes(contents.evaluation)[1:],
        *([_describe_paper(contents)] if beside else []),
    ]
    return Table(named, tuple(head), tuple(row[: len(head)] for row in rows), tuple(below))


def _has_references(contents: ReportContents) -> bool:
    return any(entry.row.metrics is not None for entry in contents.entries)


def _has_denoisers(contents: ReportContents) -> bool:
    return any(entry.row.kept is not None for entry in contents.entries)


def _describe_time(contents: ReportContents) -> str:
    if contents.costs is None:
        return f"time per frame: n/a, as {contents.untimed}"
    frames, edit = contents.costs.render_s.shape[1], contents.costs.parts()["edit_s"]
    on_cpu = ", ready denoisers on the CPU" if any(entry.architecture is None for entry in contents.entries) else ""
    return (
        f"time per frame: medians of {frames} frames for rendering, buffers, points and photons, on one core by LLVM's "
        f"code; of {TIMED_ROUNDS} calls, taken by turns, for networks, on {describe_device(contents.evaluation)}"
        f"{on_cpu if contents.evaluation.device != 'cpu' else ''}; editing the scene, {_format_times(edit)} ms, "
        "which all need, is not in it"
    )


def _describe_paper(contents: ReportContents) -> str:
    film, unit = contents.card.spec.film, contents.measure.published
    times = (
        "“paper” are the published figures, of four other rooms' average at 256² with networks of width 64 on another "
        "machine: orders of errors can be compared, values cannot. Of time, the networks' ratios can"
        f"{'' if unit is None else f' ({contents.measure.architecture} took {unit.seconds:g} s there)'}"
    )
    if not _has_denoisers(contents):
        return times
    return (
        f"{times}. The denoisers' cannot: their time is mostly rendering, here of "
        f"{contents.card.spec.transport.half_spp} samples per pixel at {film.width} × {film.height}, where starting "
        "takes much of it, and of another number in the paper"
    )


def _format_paper_row(contents: ReportContents, entry: ReportEntry, *, beside: bool) -> tuple[str, ...]:
    estimates, paper, unit = entry.estimates, entry.published, contents.measure
    cells = [
        (format_milliseconds(entry.time.total) if entry.time else NOT_AVAILABLE, None),
        (_format_ratio(entry, unit, alone=len(contents.entries) == 1), _format_published_ratio(entry, unit)),
        (format_with_interval(estimates.get("mse"), 5), f"{paper.mse:.4f}" if paper else ""),
        (format_with_interval(estimates.get("mssim"), 3), f"{paper.mssim:.3f}" if paper else ""),
        (format_with_interval(estimates.get("fid"), 1), f"{paper.fid:.1f}" if paper else ""),
        (format_with_interval(estimates.get(HEADLINE), 3), f"{paper.feature_l1:.3f}" if paper else ""),
    ]
    row = [entry.name]
    for ours, theirs in cells:
        row.append(ours)
        if beside and theirs is not None:
            row.append(theirs)
    return tuple(row)


def _format_ratio(entry: ReportEntry, unit: ReportEntry, *, alone: bool) -> str:
    if alone:
        return ""
    return NOT_AVAILABLE if entry.time is None or unit.time is None else f"{entry.time.total / unit.time.total:.2f}"


def _format_published_ratio(entry: ReportEntry, unit: ReportEntry) -> str:
    if entry.published is None or unit.published is None:
        return ""
    return f"{entry.published.seconds / unit.published.seconds:.2f}"


def format_with_interval(estimate: Estimate | None, digits: int) -> str:
    """Mean and 95 % interval."""
    if estimate is None:
        return NOT_AVAILABLE
    interval = confidence_interval(estimate)
    reach = "" if interval is None else f" ({interval[0]:.{digits}f} … {interval[1]:.{digits}f})"
    return f"{estimate.mean:.{digits}f}{reach}"


# -------------------------------------------------------------------------------------------------------------- further


def _make_further_table(contents: ReportContents) -> Table:
    """Metrics that the paper does not have, and its Fig. 5 in numbers."""
    shown = [m for m in TITLES if m.startswith(("feature", "flip"))] if _has_references(contents) else []
    first = contents.evaluation.rows[0]
    rows = []
    for entry in contents.entries:
        behind = "–" if entry.row is first else format_with_interval(entry.row.behind(first), 5)
        estimates = entry.estimates
        cells = [f"{estimates[m].mean:.4f}" if m in estimates else NOT_AVAILABLE for m in shown]
        kid = [format_with_interval(estimates.get("kid"), 4)] if shown else []
        rows.append((entry.name, format_with_interval(entry.row.held_out.error, 5), behind, *cells, *kid))
    titles = (*(TITLES[m] for m in shown), *(["KID (95 %)"] if shown else []))
    head = ("architecture", "linear MSE (95 %)", f"more than {contents.entries[0].name}", *titles)
    below = [list_notes(contents.evaluation)[0]]
    if (metrics := first.metrics) is not None and (weights := metrics.inception) is not None:
        below.append(
            f"FID, KID and Feature L1: {metrics.images} images and as many references; Inception weights of "
            f"{weights.source}, sha256 {weights.sha256}; images are resized to 299 × 299 bilinearly without aligned "
            "corners. KID's interval is the jackknife's over views; FID has none"
        )
    return Table("Further metrics", head, tuple(rows), tuple(below))


def _make_frame_tables(contents: ReportContents) -> list[Table]:
    if contents.costs is None:
        return []
    rows = tuple(
        (
            entry.name,
            *(_format_times(part) if part else "–" for part in entry.time.parts.values()),
            format_milliseconds(entry.time.total),
        )
        for entry in contents.entries
        if entry.time
    )
    head = ("architecture", "render 1/k", "buffers", "guides", "points seen", "photons", "network", "all")
    below = ["milliseconds: the median, and the middle 80 % of the times"]
    if _has_denoisers(contents):
        below.append(
            "denoisers are given one half-estimate of 1/k of the pixels; as splats of light paths do not stop at "
            "these, their light paths are as many as for the whole image (up to 64 × as many per pixel)"
        )
    networks = {story.name: story.run.settings.network for story in contents.stories}
    transport = {name: of for name, of in networks.items() if of.architecture.startswith("light_transport")}
    if relative := [name for name, of in transport.items() if of.maxima == "relative"]:
        below.append(
            f"{', '.join(relative)}: maxima are relative, for which the network runs over the base cloud anew in each "
            "frame, though what that gives is the same each time: a renderer would keep it"
        )
    return [Table("Where the time of a frame goes", head, rows, tuple(below))]


def _format_times(time: Seconds) -> str:
    low, high = format_milliseconds(time.low), format_milliseconds(time.high)
    return f"{format_milliseconds(time.median)} ({low} … {high})"


# ---------------------------------------------------------------------------------------------------------- runs, cases


def _make_run_table(contents: ReportContents) -> Table:
    rows = []
    for story in contents.stories:
        about = story.document()
        shares = about["waits"]
        rows.append(
            (
                story.name,
                f"{about['parameters']:,}",
                f"{about['steps']}",
                f"{about['draws_per_sample']:.1f}",
                f"{about['seconds']['train'] / 60:.1f}",
                f"{shares['samples']:.1%}",
                f"{shares['reading']:.1%}",
                f"{about['samples_per_used']:.2f}",
                about["bottleneck"],
            )
        )
    head = (
        "run",
        "parameters",
        "steps",
        "draws per sample",
        "minutes of steps",
        "waited for samples",
        "for reading",
        "samples there for each used (--ahead)",
        "bottleneck",
    )
    return Table("Training", head, tuple(rows))


def _make_worst_tables(contents: ReportContents) -> list[Table]:
    if not contents.worst:
        return []
    rows = tuple((c.kind, f"{c.row}", f"{c.pixels:.1%}", f"{c.mse:.4f}") for c in contents.worst)
    note = (
        f"of all views with references, those in which pixels of one kind cost {contents.entries[0].name} most: the "
        "sum of their squared error in the metric space, the references' noise taken out; one view may be the worst of "
        "several kinds. Near surfaces: the nearest 5 % of what is seen. Fine shadows: in both halves of the reference "
        "light steps where surface, normal and colour do not"
    )
    return [Table("Worst cases", ("kind of pixels", "row of the store", "of the image", "MSE there"), rows, (note,))]
