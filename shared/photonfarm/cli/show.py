"""What the command line prints: tables for people, JSON for programs."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click
from rich import markup
from rich.console import Console, RenderableType
from rich.table import Table

from photonfarm.core.formatting import format_bytes, format_count
from photonfarm.core.waiting import format_span
from photonfarm.scene.groups import shape_ids
from photonfarm.scene.spec import SceneSpec, Transport

if TYPE_CHECKING:
    from photonfarm.farm.dry_run import DryRun
    from photonfarm.farm.submission import Submission


def print_json(document: Any) -> None:
    """Print JSON for programs."""
    click.echo(json.dumps(document, indent=2))


def make_table(rows: Iterable[tuple[RenderableType, ...]], head: tuple[str, ...] = ()) -> Table:
    """Rows as a table, with a head or without one; text is shown as it is."""
    table = Table(*head, box=None, show_header=bool(head), pad_edge=False)
    for row in rows:
        table.add_row(*(markup.escape(cell) if isinstance(cell, str) else cell for cell in row))
    return table


def print_table(rows: Iterable[tuple[str, ...]], head: tuple[str, ...] = ()) -> None:
    """Print `make_table`."""
    console = Console(soft_wrap=True)
    console.width = max(console.width, 132)  # ids are for copying: never cut
    console.print(make_table(rows, head), highlight=False)


# ----------------------------------------------------------------------------------------------------------- scene show


def print_scene(spec: SceneSpec, as_json: bool) -> None:
    """Print a checked spec: its id, its settings, its movable groups."""
    if as_json:
        sizes = {"bytes_per_sample": bytes_per_sample(spec)}
        print_json({"scene_id": spec.scene_id, **sizes, **spec.model_dump(mode="json")})
        return
    t, source = spec.transport, spec.scene
    print_table(
        (
            ("name", spec.name),
            ("scene id", spec.scene_id),
            ("source", source.file or f"built-in {source.builtin}"),
            ("kind", f"dynamic, {format_count(len(spec.groups), 'movable group')}" if spec.groups else "static"),
            ("film", f"{spec.film.width} × {spec.film.height}, field of view {spec.view.describe_fov()}"),
            ("light transport", f"depth {t.max_depth}, {_describe_strategy(t)}"),
            *([("on a card", _describe_strategy(t.on_card))] if t.card else []),
            ("half-estimates", f"2 × {t.half_spp} samples per pixel"),
            ("views from", _box(spec.view.origin.min, spec.view.origin.max)),
            ("looking at", _box(spec.view.look_at.min, spec.view.look_at.max)),
            ("point cloud", format_count(spec.points, "point")),
            ("photons", f"{spec.photons.paths} paths, {spec.photons.depth} hits each"),
            ("exposure", f"{spec.exposure:g}"),
            ("bytes per sample", f"≤ {bytes_per_sample(spec):,} with its own view and modification"),
        )
    )
    if spec.groups:
        click.echo()
        head = ("movable", "shapes", "removed", "positions", "changes")[: 4 + spec.further_changes]
        print_table(
            (
                (g.name, str(len(shape_ids(g))), f"{g.removal_probability:g}", _box(g.box.min, g.box.max), g.changes)[
                    : len(head)
                ]
                for g in spec.groups
            ),
            head,
        )


def _describe_strategy(transport: Transport) -> str:
    """How light is sampled, in words."""
    return (
        f"{transport.connections} connections, light ratio {transport.light_ratio:g}"
        + ", guided light" * transport.guided_light
        + (f", {transport.light_samples} light samples" if transport.light_samples > 1 else "")
        + (f", roulette from edge {transport.rr_depth}" if transport.rr_depth != Transport().rr_depth else "")
    )


def bytes_per_sample(spec: SceneSpec) -> int:
    """The stored bytes of one sample that has a view and a modification of its own, before compression."""
    from photonfarm.store.format.schema import bytes_of_rows

    return sum(bytes_of_rows(spec).values())


def _box(low: tuple[float, ...], high: tuple[float, ...]) -> str:
    return " × ".join(f"{a:g}" if a == b else f"{a:g}…{b:g}" for a, b in zip(low, high, strict=True))


# --------------------------------------------------------------------------------------------------------------- submit


def print_submission(result: Submission, as_json: bool) -> None:
    """Print the outcome of a submission, or of a dry run of one."""
    from photonfarm.farm.dry_run import DryRun

    if as_json:
        print_json(asdict(result))
        return
    planned = f"scene {result.scene_id}: {format_count(result.planned, 'sample')}"
    if result.dry_run:
        click.echo(f"{planned} would be planned, {result.planned_before} are already")
        if isinstance(result, DryRun) and result.planned:
            _print_cost(result)
        return
    queued = "not queued" if result.queued is None else f"{format_count(result.queued, 'job')} queued"
    click.echo(f"{planned} planned, {result.planned_before} planned before, {queued}")
    if result.note:
        click.echo(result.note, err=True)
    if result.replaced:
        click.echo(f"the store's spec is replaced, and no sample changes: {result.replaced}", err=True)
    if result.halves_from:
        click.echo(f"jobs take over the halves that scene {result.halves_from} has, and render the rest", err=True)
    if result.scenes:
        from photonfarm.scene.spec_loading import SCENES_VARIABLE

        click.echo(f"workers find its scene file with {SCENES_VARIABLE}={result.scenes}", err=True)


def _print_cost(result: DryRun) -> None:
    """Print the size and the cost of what would be planned, and a better use of the same cost."""
    size = f"at most {format_bytes(result.size_bytes)} before compression"
    if result.card_s is not None:
        size += f"; about {format_span(result.card_s)} on a card such as an H200, by its pace in other rooms"
    if result.core_s is None or result.wall_s is None:
        click.echo(size)
        return
    core_s = f"{result.core_s:,.0f}" if result.core_s >= 10 else f"{result.core_s:.2g}"
    cores = format_count(result.cores, "core")
    where = f"{cores}, a worker each" if result.workers else f"the {cores} here"
    click.echo(f"{size}; {core_s} core-seconds: {format_span(result.wall_s)} on {where}")
    if result.reduction is not None:
        click.echo(_describe_suggestion(result))
    elif result.planned_before:
        click.echo("no suggestion: another half_spp would render again what is planned already")


def _describe_suggestion(result: DryRun) -> str:
    better = result.suggestion
    if better is None or result.reduction is None:
        return "what is asked for is within 5 % of the best at this cost"
    request = f"{format_count(better.samples, 'view')} of one pass"
    if better.views is not None:
        options = f"--modifications {better.modifications} --views {better.views}"
        request = f"{options} ({format_count(better.samples, 'sample')} of one pass)"
    return (
        f"suggested at this cost: half_spp = {better.half_spp} in [transport], {request}: "
        f"{100 * result.reduction:.0f} % less excess error predicted for light_transport; with guided networks, "
        "as trained by default, it hardly matters"
    )
