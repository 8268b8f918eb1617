"""The verb `slurm`, which needs neither Mitsuba nor torch."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from photonfarm.cli.options import (
    json_option,
    no_queue_option,
    optional_redis_option,
    password_file,
    request_options,
    retry_option,
    run_option,
    store_option,
)
from photonfarm.core.formatting import format_count

if TYPE_CHECKING:
    from photonfarm.plan.request import Request


@click.command()
@click.argument("specs", metavar="SPEC...", nargs=-1, required=True)
@request_options
@store_option
@optional_redis_option(
    "The queue's Redis, if nodes reach one. A password belongs into the file that "
    "PHOTONFARM_REDIS_PASSWORD_FILE names.  [default: none; the store alone says what is missing]"
)
@no_queue_option
@retry_option
@click.option(
    "--workers",
    type=click.IntRange(1),
    default=4,
    show_default=True,
    help="Render workers: tasks of the array, a core each.",
)
@click.option("--partition", metavar="NAME", help="SLURM's partition.  [default: the cluster's]")
@click.option(
    "--time",
    metavar="LIMIT",
    help="Time limit of a task, as sbatch takes it; at least 3 "
    "minutes. A task that its limit ends puts itself back into the queue.  [default: the partition's]",
)
@click.option("--gpus", is_flag=True, help="Render on GPUs: one for each worker.")
@click.option(
    "--sbatch",
    "further",
    multiple=True,
    metavar="OPTION",
    help="A further option of sbatch, as --sbatch=--account=lab; may be repeated.",
)
@click.option(
    "--logs",
    type=click.Path(path_type=Path, file_okay=False),
    default="slurm",
    show_default=True,
    help="Folder of the scripts and of a log for each task.",
)
@click.option("--train", is_flag=True, help="Also start the trainer, as a job of its own, once the first worker runs.")
@run_option
@click.option("--train-steps", type=click.IntRange(1), help="Steps to train for.  [default: the preset's]")
@click.option("--train-gpus", is_flag=True, help="Train on a GPU.")
@click.option(
    "--train-sbatch",
    "train_further",
    multiple=True,
    metavar="OPTION",
    help="As --sbatch, for the trainer's job alone: --train-sbatch=--partition=gpu.",
)
@click.option("--dry-run", is_flag=True, help="Print the scripts, with a rough cost, and write and submit nothing.")
@json_option
def slurm(
    specs: tuple[str, ...],
    store: str | Path,
    queue_url: str | None,
    request: Request,
    shard_rows: int | None,
    no_queue: bool,
    retry: bool,
    dry_run: bool,
    as_json: bool,
    **options: Any,  # the fields of `Asked`, by click's names
) -> None:
    """Plan samples of each SPEC, and render them by workers that SLURM runs as an array.

    Without Redis the workers share the jobs by the store alone (`photonfarm work --share`). A task that is preempted,
    that loses its node or reaches its time limit goes back into the queue, and loses the job in hand. The same command
    goes on from what is stored.

    Exit code 9: sbatch is not here, or refuses.
    """
    from photonfarm.farm.slurm import Asked, check_slurm, launch, make_scripts
    from photonfarm.scene.spec_loading import NamedSpec

    asked = Asked(**options)
    if asked.train and len(specs) > 1:
        raise click.UsageError("--train takes one SPEC: a trainer trains on one scene")
    queue_url = None if no_queue else queue_url
    named = [NamedSpec.load(spec) for spec in specs]
    scripts = make_scripts(named, store, queue_url, asked)
    if dry_run:
        from photonfarm.farm.dry_run import describe_roughly

        costs = [f"# {describe_roughly(each.spec, request, asked.workers, on_cards=asked.gpus)}" for each in named]
        click.echo("\n".join(scripts.values()).replace("\n", "\n".join(["", *costs, ""]), 1), nl=False)
        return
    check_slurm()
    from photonfarm.farm.hold_out_checks import find_hold_out_warning
    from photonfarm.farm.submission import queue_missing, submit
    from photonfarm.scene.plausibility import warnings
    from photonfarm.store import Store

    planned = []  # all scenes are planned first, without a queue, which is then filled once
    for spec in named:
        for warning in filter(None, (*warnings(spec), find_hold_out_warning(spec.spec, store, request))):
            click.echo(f"warning: {warning}", err=True)
        submission = submit(spec, store, None, request, retry=retry, shard_rows=shard_rows, workers=asked.workers)
        samples = format_count(submission.planned, "sample")
        click.echo(f"scene {submission.scene_id}: {samples} planned, {submission.planned_before} before", err=True)
        planned.append(submission)
    if queue_url is not None:
        from photonfarm.queue.connection import add_password

        queue_missing(Store(store), add_password(password_file(), queue_url), retry=retry)
    started = launch(scripts, asked.logs.absolute())
    if as_json:
        from photonfarm.cli import show

        show.print_json({"plans": list(map(asdict, planned)), **asdict(started)})
        return
    click.echo(f"job {started.workers}: {format_count(asked.workers, 'worker')}; logs in {started.logs}")
    if started.trainer is not None:
        click.echo(f"job {started.trainer}: the trainer, which begins once the first worker has")
