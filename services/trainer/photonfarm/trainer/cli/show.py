"""What verbs print while they work: bars on a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click
from rich import markup
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from photonfarm.core.formatting import format_count
from photonfarm.core.processes import repeat
from photonfarm.core.statistics import format_estimate
from photonfarm.core.waiting import SILENCE_S, Steps
from photonfarm.trainer.runs import progress
from photonfarm.trainer.runs.advice import LEARNED_BY_HEART, knows_noise

if TYPE_CHECKING:
    from photonfarm.trainer.dry_run import DryRun


def print_record(of: dict[str, Any]) -> None:
    """Print what people want to know of a record of a run's log, if anything."""
    if of["kind"] == "changes":
        changed = ", ".join(f"{key} = {now!r} (before {then!r})" for key, (then, now) in of["changes"].items())
        click.echo(f"settings changed at step {of['step']}: {changed}", err=True)
    if of["kind"] == "start":
        anew = f", but for {', '.join(of['anew'])}, which is of another scene's points" if of["anew"] else ""
        click.echo(f"begins with the weights of step {of['of_step']} of run {of['run']}{anew}", err=True)
    if of["kind"] == "loss":
        click.echo(f"loss {of['loss']} is unbiased: {of['verdict']}", err=True)
    if of["kind"] == "recovered":
        click.echo(f"step {of['step']}: {_format_recovery(of)}", err=True)
    if of["kind"] == "end" and of["advice"]:
        click.echo(of["advice"], err=True)
    if of["kind"] == "validation":
        views = f"on {format_count(of['held_out'], 'view')}, {format_count(of['samples'], 'sample')} arrived"
        there = f"{views}; {_format_rounds(of)}{_format_poor(of['poor'])}"
        click.echo(
            f"step {of['step']}: held-out error {format_estimate(of['error'], of['standard_error'])} "
            f"({format_estimate(of['shown_error'], None)} up to white) {there}"
            + progress.format_waits(of["waits"], of["samples_per_used"]),
            err=True,
        )


def _format_rounds(of: dict[str, Any]) -> str:
    """How often a network was given each half, and whether it has learned by heart what it goes with."""
    if "rounds" not in of:
        return ""
    knows = of["excess_held_out"] and knows_noise(of["excess"], of["excess_held_out"][0])
    heart = " and learns their noise by heart, as its loss is below that of clean images" if knows else ""
    return f"has seen each half in {of['rounds']:.1f} rounds{heart}; "


def _format_poor(shares: dict[str, float]) -> str:
    """How much of the training views take that are black or near; "" if there are none."""
    if not shares:
        return ""
    samples, gradient = (f"{100 * shares[name]:.2g}%" for name in ("samples", "gradient"))
    return f"black or near views: {samples} of samples, {gradient} of squared gradient; "


def print_dry_run(estimate: DryRun, as_json: bool) -> None:
    """Print the estimate of a training."""
    from photonfarm.trainer.dry_run import format_dry_run

    click.echo(json.dumps(estimate.document(), indent=2) if as_json else format_dry_run(estimate))


def _format_recovery(log_record: dict[str, Any]) -> str:
    """Why a run went back, and to which step."""
    back_to = f"the weights of step {log_record['back_to']}"
    values, what = log_record["errors"] or log_record["losses"], log_record["what"]
    now, before = (None if value is None else format_estimate(value, None) for value in values.values())
    if now is None:
        reason = f"the {what} is not finite"
    else:
        reason = f"{what} {now} ({'best so far' if log_record['errors'] else 'usually up to'} {before})"
    if log_record["cause"] == LEARNED_BY_HEART:
        reason = f"{reason}, as the network learns its samples by heart"
    if log_record["cause"] in ("end", LEARNED_BY_HEART):
        return f"{reason}; ends with {back_to}"
    return f"{reason}; goes on from {back_to}, at {log_record['rate_factor']:g} of the rate"


OnProgress = Callable[[str, int, int], None]


@contextmanager
def show_progress() -> Iterator[OnProgress]:
    """Yield a callback with what is done, how many of its samples are done, and of how many; 0: it has no parts."""
    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    name, since_s, samples, bar = "starts", time.monotonic(), Steps(0), None
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:

        def show(what: str, done: int, total: int) -> None:
            nonlocal name, since_s, samples, bar
            if what != name:
                if bar is not None and not samples.total:
                    bars.remove_task(bar)  # the bars of predictors stay
                name, since_s, samples = what, time.monotonic(), Steps(total)
                bar = bars.add_task(markup.escape(name), total=total or None)
                if not total and not console.is_terminal:
                    click.echo(name, err=True)
            samples.reach(done)
            if bar is not None:
                bars.update(bar, completed=done)
            if total and done == total and not console.is_terminal:
                click.echo(f"{name}: {format_count(total, 'sample')}", err=True)

        def print_line() -> None:
            if not console.is_terminal:
                so_far = f": sample {samples.words()}" if samples.total else f", for {time.monotonic() - since_s:.0f} s"
                click.echo(f"{name}{so_far}", err=True)

        with repeat(SILENCE_S, print_line):
            yield show
