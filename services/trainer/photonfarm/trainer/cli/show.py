"""What `train` prints while it trains."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import click

from photonfarm.shared.core.estimate import stated
from photonfarm.trainer.runs import wait_times

if TYPE_CHECKING:
    from photonfarm.trainer.dry_run.dry_run import DryRun


def record(of: dict[str, Any]) -> None:
    """Print what people want to know of a record of a run's log, if anything."""
    if of["kind"] == "changes":
        changed = ", ".join(f"{key} = {now!r} (before {then!r})" for key, (then, now) in of["changes"].items())
        click.echo(f"settings changed at step {of['step']}: {changed}", err=True)
    if of["kind"] == "loss":
        click.echo(f"loss {of['loss']} is unbiased: {of['verdict']}", err=True)
    if of["kind"] == "recovered":
        click.echo(f"step {of['step']}: {_recovered(of)}", err=True)
    if of["kind"] == "validation":
        there = f"on {of['held_out']} of {of['samples']} samples; "
        click.echo(
            f"step {of['step']}: held-out error {stated(of['error'], of['standard_error'])} "
            f"({stated(of['shown_error'], None)} up to white) {there}"
            + wait_times.stated(of["waits"], of["samples_per_used"]),
            err=True,
        )


def dry_run(found: DryRun, as_json: bool) -> None:
    """Print the estimate of a training."""
    from photonfarm.trainer.dry_run.printed import document, text

    click.echo(json.dumps(document(found), indent=2) if as_json else text(found))


def _recovered(log_record: dict[str, Any]) -> str:
    """Why a run went back, and to which step."""
    errors, back_to = log_record["errors"], f"the weights of step {log_record['back_to']}"
    if errors is None:
        found = "the loss is not finite"
    elif errors["now"] is None:
        found = "the held-out error is not finite"
    else:
        found = f"held-out error {stated(errors['now'], None)} (best so far {stated(errors['best'], None)})"
    if log_record["cause"] == "end":
        return f"{found}; ends with {back_to}"
    return f"{found}; goes on from {back_to}, at {log_record['rate_factor']:g} of the rate"
