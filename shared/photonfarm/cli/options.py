"""Options that several verbs share."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from functools import reduce, wraps
from pathlib import Path
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from photonfarm.core.processes import loading

Command = TypeVar("Command", bound=Callable[..., Any])


class StorePlace(click.Path):
    """A folder, as a Path; or the URL of a bucket, as it is written."""

    name = "folder or url"

    def __init__(self) -> None:
        super().__init__(path_type=Path, file_okay=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The Path or the URL; fails for a URL that is not that of a bucket."""
        with loading():
            from photonfarm.store.io.storage import SCHEMES, is_url

        if re.match(r"(s3|gs|az):/?[^/]", str(value)):
            self.fail(f"{value!r} is no URL of a bucket; write {str(value)[:2]}://BUCKET/PREFIX.", param, ctx)
        if not is_url(value):
            return super().convert(value, param, ctx)
        scheme, _, bucket = value.partition("://")
        if scheme not in SCHEMES or not bucket.strip("/"):
            self.fail(f"{value!r} is neither a folder nor {'://…, '.join(SCHEMES)}://… with a bucket.", param, ctx)
        return value


class RunFolder(click.Path):
    """The folder of a training run, by default as a Path."""

    name = "folder"

    def __init__(self, path_type: type = Path) -> None:
        super().__init__(path_type=path_type, file_okay=False)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The folder, which need not be there; fails for a file."""
        if Path(value).is_file():
            from photonfarm.farm.training import NO_FOLDER

            self.fail(f"{str(value)!r} {NO_FOLDER}.", param, ctx)
        return super().convert(value, param, ctx)


class WholeNumber(click.IntRange):
    """A whole number in a range, also written like 1e3 or 10_000."""

    name = "integer"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number; fails for text that is none, and for a fraction."""
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            return super().convert(value, param, ctx)  # which says so
        if not number.is_integer():
            self.fail(f"{value!r} is not a whole number.", param, ctx)
        exact = isinstance(value, str) and value.strip().isdigit()  # more digits than a float has
        return super().convert(int(value if exact else number), param, ctx)


store_option = click.option(
    "--store",
    type=StorePlace(),
    metavar="DIR|URL",
    envvar="PHOTONFARM_STORE",
    default="store",
    show_default=True,
    help="The sample store: a folder, or s3://bucket/prefix (credentials: the AWS_… variables).",
)
run_option = click.option(
    "--run",
    type=RunFolder(),
    default="run",
    show_default=True,
    help="The trainer's folder.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
retry_option = click.option(
    "--retry", is_flag=True, help="Also take up again jobs that were set aside after repeated failures."
)
no_queue_option = click.option(
    "--no-queue", is_flag=True, help="Use no Redis, even if one is named: workers find the plan by themselves."
)


def combine_options(*options: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A decorator that adds several options, the first one on top."""
    return lambda command: reduce(lambda decorated, option: option(decorated), reversed(options), command)


address_options = combine_options(
    click.option(
        "--host",
        default="localhost",
        show_default=True,
        help="The address to listen on; whoever reaches any other one sees all that is served.",
    ),
    click.option(
        "--name",
        "names",
        multiple=True,
        help="A name, beside the host's, by which others may ask; may be repeated.",
    ),
)
"""The options that say where pages are served."""


def _check_password(ctx: click.Context, param: click.Parameter, url: str | None) -> str | None:
    if url and ctx.get_parameter_source(param.name or "") is ParameterSource.COMMANDLINE:
        from photonfarm.queue.connection import has_password

        if has_password(url):
            raise click.BadParameter(
                "a password on the command line can be read by everybody on this machine, and stays in the shell's "
                "history; give the URL without it, and put the password into a file that "
                "PHOTONFARM_REDIS_PASSWORD_FILE names. (A URL with a password may stand in PHOTONFARM_REDIS_URL, or as "
                "`redis` in the configuration file.)"
            )
    return url or None


def _add_password(ctx: click.Context, param: click.Parameter, url: str) -> str:
    _check_password(ctx, param, url)
    if (file := password_file()) is None:
        return url
    from photonfarm.queue.connection import add_password

    return add_password(file, url)


redis_option = click.option(
    "--redis",
    "redis_url",
    envvar="PHOTONFARM_REDIS_URL",
    default="redis://localhost:6379/0",
    show_default=True,
    help="The queue's Redis. A password is refused here, as command lines can be read by all; it belongs into the "
    "file that PHOTONFARM_REDIS_PASSWORD_FILE names, and is the user photonfarm's unless the URL names another: "
    "redis://default@host for a Redis with requirepass.",
    show_envvar=True,
    callback=_add_password,
)
"""The queue's server; its password may come from the file that a variable names."""


def optional_redis_option(help_text: str) -> Callable[[Command], Command]:
    """`--redis URL` without a default, as `queue_url`; the file of its password is not read."""
    variable = "PHOTONFARM_REDIS_URL"
    return click.option(
        "--redis", "queue_url", envvar=variable, show_envvar=True, callback=_check_password, help=help_text
    )


def password_file() -> Path | None:
    """The file that holds the password of Redis, if a variable names one."""
    file = os.environ.get("PHOTONFARM_REDIS_PASSWORD_FILE")
    return Path(file) if file else None


def names_redis() -> bool:
    """Whether the user of the current command has named its Redis, in any way."""
    context = click.get_current_context(silent=True)
    return context is None or context.get_parameter_source("redis_url") is not ParameterSource.DEFAULT


def device_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """`--device`, what renders; the verb and its child processes find it in the environment."""
    from photonfarm.farm.devices import AUTO, DEVICE_VARIABLE

    @wraps(command)
    def on_device(*arguments: Any, device: str, **options: Any) -> Any:
        if click.get_current_context().get_parameter_source("device") is not ParameterSource.DEFAULT:
            os.environ[DEVICE_VARIABLE] = device
        return command(*arguments, **options)

    return click.option(
        "--device",
        envvar=DEVICE_VARIABLE,
        default=AUTO,
        show_default=True,
        show_envvar=True,
        metavar="auto|cpu|cuda[:N]",
        callback=check_device,
        help="What renders: the processor, the first NVIDIA card, card N as nvidia-smi numbers them; auto: a card, "
        "where there is one that can.",
    )(on_device)


def check_device(ctx: click.Context, param: click.Parameter, name: str) -> str:  # noqa: ARG001
    """The name of a device; fails for one that has another form."""
    from photonfarm.farm.devices import NAMES

    if not NAMES.fullmatch(name):
        raise click.BadParameter(f"{name!r} is none of auto, cpu, cuda and cuda:N.")
    return name


def request_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that make a request, which the command gets as `request`, and `shard_rows`."""

    @wraps(command)
    def with_request(*, modifications: int, views: int, passes: int, seed: int, **options: Any) -> Any:
        from photonfarm.plan.request import Request

        asked = {"modifications": modifications, "views_per_modification": views, "passes": passes, "seed": seed}
        return command(request=Request.of(**asked), **options)

    return combine_options(
        click.option(
            "--modifications",
            type=WholeNumber(1),
            default=128,
            show_default=True,
            help="Random configurations; a static scene has one, of which modifications × views are planned.",
        ),
        click.option("--views", type=WholeNumber(1), default=2, show_default=True, help="Views per configuration."),
        click.option("--passes", type=WholeNumber(1), default=1, show_default=True, help="Noisy passes per view."),
        click.option("--seed", type=WholeNumber(0), default=0, show_default=True, help="Master seed; 0 is a seed."),
        click.option(
            "--shard-rows",
            type=WholeNumber(1, 4096),
            default=None,
            help="Samples per job, fixed for a scene by its first plan.  [default: some seconds of work, at "
            "most 32, and several jobs for every worker]",
        ),
    )(with_request)


def _parse_numbers(text: str, form: str) -> Any:
    """Finite numbers as in the form X,Y,Z, or one of a form without a comma."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    count = form.count(",") + 1
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        wanted = "a finite number is" if count == 1 else f"{count} finite numbers are"
        raise click.BadParameter(f"{text!r}: {wanted} required, as {form}.")
    return numbers if count > 1 else numbers[0]


def _parse_point(ctx: click.Context, param: click.Parameter, text: str | None) -> Any:  # noqa: ARG001
    return None if text is None else _parse_numbers(text, "X,Y,Z")


def _parse_named(ctx: click.Context, param: click.Parameter, texts: tuple[str, ...]) -> dict[str, Any]:  # noqa: ARG001
    """Numbers by the names before them, in the form of the option's metavar."""
    found: dict[str, Any] = {}
    for text in texts:
        name, _, numbers = text.rpartition("=")
        if not name or name in found:
            raise click.BadParameter(f"{text!r}: {param.metavar} is required, and each name once.")
        found[name] = _parse_numbers(numbers, str(param.metavar).rpartition("=")[2])
    return found


NAMED = {
    "--place": ("NAME=X,Y,Z", "Where a group stands, as `at` in the spec; repeatable."),
    "--move": ("NAME=X,Y,Z", "By how much a group goes from where it stands; repeatable."),
    "--turn": ("NAME=DEGREES", "How a group is turned about its up axis, from how it was modelled; repeatable."),
    "--power": ("NAME=FACTOR", "By what a light's power is multiplied, 0 is dark; repeatable."),
    "--colour": ("NAME=R,G,B", "By what a light's red, green and blue are multiplied, beside that; repeatable."),
}
"""Options of what changes, by groups' names: their forms and their help."""


def arrangement_options(*, camera: bool = True) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """What stands where, by names, and with `camera` from where it is seen: the command gets it as `asked`."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def with_arrangement(**options: Any) -> Any:
            from photonfarm.scene.arrangement import Arrangement, Shot

            kind = Shot if camera else Arrangement
            asked = {name: options.pop(name) for name in kind.model_fields}
            return command(asked=kind.of(**asked), **options)

        point: dict[str, Any] = {"metavar": "X,Y,Z", "callback": _parse_point}
        of_camera = (
            click.option("--camera", help="Where the camera stands.", **point),
            click.option("--look-at", help="The point that it looks at.", **point),
            click.option(
                "--fov",
                type=click.FloatRange(1, 170),
                metavar="DEGREES",
                help="Its field of view along the width.  [default: spec's]",
            ),
        )
        return combine_options(
            *(
                click.option(name, metavar=form, multiple=True, callback=_parse_named, help=said)
                for name, (form, said) in NAMED.items()
            ),
            click.option("--without", multiple=True, metavar="NAME", help="A group to leave out; repeatable."),
            *(of_camera if camera else ()),
        )(with_arrangement)

    return decorate


def refuse_own_folder(folder: Path) -> None:
    """Raise BadParameter for a folder to write pictures into that is a sample store or a training run."""
    from photonfarm.farm.training import SETTINGS
    from photonfarm.store.io.storage import FORMAT_FILE

    for name, what in ((FORMAT_FILE, "a sample store"), (SETTINGS, "a training run")):
        if (folder / name).exists():
            raise click.BadParameter(
                f"{folder}: is {what}, as it holds {name}; name another folder", param_hint="--out"
            )


like_option = click.option("--like", metavar="KEY", help="What has this key: a configuration, a view or a sample.")

start_options = combine_options(
    click.option("--row", type=click.IntRange(0), help="Begin with what the sample in a row of the store shows."),
    click.option("--like", metavar="KEY", help="Begin with what has this key: a configuration, a view or a sample."),
)
"""What an arrangement changes, as `find_start` takes it; by default the scene at rest."""

shot_file_options = combine_options(
    click.option(
        "--cameras",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="FILE",
        help="The cameras of this transforms.json, of nerfstudio or of `export --to exr`.",
    ),
    click.option(
        "--configurations",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="FILE",
        help="The configurations of this JSON or CSV file, by the names of groups.",
    ),
)
"""Files of what stands where and of what looks at it, as `read_shots` takes them."""
