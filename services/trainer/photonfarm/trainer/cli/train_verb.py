"""The verb train of the trainer service."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, get_args

import click

from photonfarm.cli.options import RunFolder, json_option, redis_option, store_option
from photonfarm.trainer.runs.settings import KEYS, PRESETS, Architecture, Loss, Optimiser, Precision, make_settings
from photonfarm.trainer.runs.user_code import is_own

run_option = click.option(
    "--run",
    type=RunFolder(),
    envvar="PHOTONFARM_RUN",
    default="run",
    show_default=True,
    help="Folder of the training run: checkpoints, metrics.",
)


class ChoiceOrOwn(click.Choice[str]):
    """One of some names, or `MODULE:NAME`."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name as written; fails for one that is neither."""
        return value if is_own(value) else super().convert(value, param, ctx)


class KeyValueOption(click.Option):
    """KEY=VALUE, repeatable; a table in a configuration file."""

    def type_cast_value(self, ctx: click.Context, value: Any) -> Any:
        """The pairs as written; a table's entries in the same form."""
        pairs = [f"{key}={json.dumps(given)}" for key, given in value.items()] if isinstance(value, Mapping) else value
        return super().type_cast_value(ctx, pairs)


def collect_settings(pairs: tuple[str, ...]) -> dict[str, Any]:
    """The values of `KeyValueOption` by their keys, each parsed as JSON, or kept as text."""
    changes: dict[str, Any] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise click.BadParameter(f"{pair!r} is not KEY=VALUE", param_hint="--set")
        name = key.strip().removeprefix("network.")
        try:
            changes[name] = json.loads(value)
        except ValueError:
            changes[name] = value.strip()
    return changes


class TrainCommand(click.Command):
    """Refuses settings that are none when it parses its arguments, so that `up` can ask before it begins."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; raises SpecError for settings that are none."""
        left = super().parse_args(ctx, args)
        if not ctx.resilient_parsing:
            self._check_settings(**ctx.params)
        return left

    @staticmethod
    def _check_settings(run: Path, preset: str | None, **params: Any) -> None:
        from photonfarm.trainer.runs.run_folder import find_own_settings  # numpy is slow to load

        changes = collect_changes(params)
        own = None if preset or params["check"] else find_own_settings(Path(run), changes)
        make_settings(own or preset or "small", changes)


def collect_changes(params: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that parameters of the verb change: those of `--set`, and before them those of their own options."""
    own = {key: value for key, value in params.items() if key in KEYS and value is not None}
    return {**collect_settings(params["pairs"]), **own}


@click.command(cls=TrainCommand)
@click.argument("spec", required=False)
@store_option
@run_option
@redis_option
@click.option(
    "--preset",
    type=click.Choice(list(PRESETS)),
    help="Settings of a new run.  [default: card on a card, small on a processor; a run that was begun keeps its own]",
)
@click.option(
    "--architecture",
    type=ChoiceOrOwn(get_args(Architecture)),
    help="Kind of network; denoise_K is given one of K pixels in noisy colour; MODULE:CLASS is one of your own.  "
    "[default: the preset's]",
)
@click.option(
    "--precision", type=click.Choice(get_args(Precision)), help="Of the U-Net's computations.  [default: float32]"
)
@click.option(
    "--steps", "max_steps", type=click.IntRange(1), help="Steps to train for.  [default: the run's, or the preset's]"
)
@click.option(
    "--seconds",
    "max_seconds",
    type=click.FloatRange(0, min_open=True),
    help="Stop after so much time in all, with waiting and what the run has had before.",
)
@click.option("--batch", type=click.IntRange(1), help="Samples per step.  [default: the preset's]")
@click.option("--seed", type=click.IntRange(0), help="Of the weights and the draws; 0 is a seed.  [default: 0]")
@click.option(
    "--start-from",
    type=RunFolder(str),
    metavar="RUN",
    help="Begin with the weights of another run, of this scene or a similar one.",
)
@click.option("--replay-ratio", type=click.FloatRange(0, min_open=True), help="Draws per sample that has arrived.")
@click.option(
    "--hold-out",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    help="Share of the configurations never trained on.  [default: the preset's, 1/8 or 1/16]",
)
@click.option("--threads", type=click.IntRange(1), help="Processor threads of torch.  [default: 1]")
@click.option("--device", metavar="NAME", help="cpu, cuda, cuda:N, or auto: cuda where there is one.  [default: auto]")
@click.option(
    "--loss",
    metavar=f"[{'|'.join(get_args(Loss))}|MODULE:FUNCTION]",
    help="Squared error; relative: to the prediction's brightness; paired: and to the other half's; MODULE:FUNCTION: "
    "your own, refused if it biases.  [default: the preset's]",
)
@click.option("--optimiser", metavar=f"[{'|'.join(get_args(Optimiser))}]", help="[default: adam]")
@click.option(
    "--learning-rate", type=click.FloatRange(0, min_open=True), help="At the beginning.  [default: the preset's]"
)
@click.option(
    "--decay", type=click.FloatRange(0, 1, min_open=True), help="Of the rate, per epoch.  [default: the preset's]"
)
@click.option("--beta2", type=float, help="Of Adam; 0.9999 or more where fireflies are rare.  [default: 0.999]")
@click.option(
    "--demodulation",
    type=float,
    help="ε; the network's output × (albedo + ε) is the image; not of guided networks.  [default: off]",
)
@click.option(
    "--set",
    "pairs",
    cls=KeyValueOption,
    multiple=True,
    metavar="KEY=VALUE",
    help=f"Any setting, also those above, whose own options come first; may be repeated: {', '.join(KEYS)}.",
)
@click.option(
    "--until-complete",
    is_flag=True,
    help="End with exit code 7, not 0, if a signal stops it, so that schedulers start it again.",
)
@click.option("--summary", is_flag=True, help="Only print the network's parameters and work, part by part.")
@click.option("--check", is_flag=True, help="Only say whether the run is alive (exit 0) or not (7).")
@click.option(
    "--dry-run",
    is_flag=True,
    help="Only estimate work, memory and time here, by a few steps on made-up samples; write nothing.",
)
@click.option(
    "--film",
    type=click.IntRange(8),
    metavar="PIXELS",
    help="With --dry-run: the side of images, instead of the spec's.",
)
@json_option
def train(
    spec: str | None,
    store: str | Path,
    run: Path,
    redis_url: str,
    preset: str | None,
    pairs: tuple[str, ...],
    until_complete: bool,
    summary: bool,
    check: bool,
    dry_run: bool,
    film: int | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Train on SPEC's samples while they arrive, or continue a run; SPEC may be left out of a store with one scene.

    A run that was begun goes on with its own settings, but for those that are named; one that has ended by its steps
    goes on with more --steps.

    Redis, where there is one, gets the number of used samples, for `photonfarm work --ahead`. Several processes share
    each batch if torchrun starts them: `torchrun --nproc-per-node 2 --no-python -- photonfarm train …`; all must
    see the same run folder. Exits with 8 if training diverges.
    """
    from photonfarm.trainer import service
    from photonfarm.trainer.cli import show

    others = (("--summary", summary), ("--check", check), ("--dry-run", dry_run))
    instead = [name for name, asked in others if asked]
    if len(instead) > 1:
        raise click.UsageError(f"{' and '.join(instead)} exclude each other; give one of them")
    if (as_json or film is not None) and not dry_run:
        raise click.UsageError(f"{'--json' if as_json else '--film'} goes with --dry-run alone")
    log = partial(click.echo, err=True)
    changes = collect_changes({"pairs": pairs, **options})
    if check:
        service.check(run)
        return
    if summary:
        click.echo(service.summarise(spec, store, service.settle_settings(run, preset, changes)))
    elif dry_run:
        settings = service.settle_settings(run, preset, changes)
        with show.show_progress() as on_progress:
            estimate = service.rehearse(spec, store, settings, film, lambda what: on_progress(what, 0, 0))
        show.print_dry_run(estimate, as_json)
    else:
        service.run(
            spec,
            store,
            run,
            preset,
            changes,
            redis_url,
            until_complete=until_complete,
            log=log,
            on_record=show.print_record,
        )
