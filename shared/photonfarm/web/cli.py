"""The verbs `web` and `serve-metrics`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from photonfarm.cli.options import (
    RunFolder,
    address_options,
    combine_options,
    names_redis,
    redis_option,
    store_option,
)
from photonfarm.farm.running_farm import METRICS_PORT, WEB_PORT

if TYPE_CHECKING:
    from photonfarm.farm.watch import FarmWatch


_watch_options = combine_options(
    store_option,
    redis_option,
    click.option(
        "--run",
        "runs",
        type=RunFolder(),
        multiple=True,
        help="Folder of a training run; may be repeated.  [default: that of an `up` at work here, or run]",
    ),
    address_options,
)
"""The options that say which farm is watched, and where that is served."""


@click.command()
@_watch_options
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    help=f"[default: {WEB_PORT}, or a free one if that is taken]",
)
def web(
    store: str | Path, redis_url: str, runs: tuple[Path, ...], host: str, port: int | None, names: tuple[str, ...]
) -> None:
    """Serve pages that show the farm while it works: samples, noise, queue, workers, training, predictions.

    They only read, and fetch nothing from elsewhere. /metrics is for Prometheus. Ends on Ctrl-C.
    """
    from photonfarm.web.farm_pages import FarmPages
    from photonfarm.web.server import listen, make_page_routes, serve

    pages = FarmPages(store, _watch(store, redis_url, runs))
    server = listen(host, port, names, usual=WEB_PORT, warn=partial(click.echo, err=True))
    serve(server, make_page_routes(pages), click.echo)


@click.command("serve-metrics")
@_watch_options
@click.option("--port", type=click.IntRange(0, 65535), default=METRICS_PORT, show_default=True, help="0: a free one.")
def serve_metrics(
    store: str | Path, redis_url: str, runs: tuple[Path, ...], host: str, port: int, names: tuple[str, ...]
) -> None:
    """Serve /metrics for Prometheus: samples, core time, queue, workers, failures, training.

    `web` serves the same beside its pages. Ends on Ctrl-C.
    """
    from photonfarm.web.images import Cached
    from photonfarm.web.server import listen, make_metric_routes, serve

    routes = make_metric_routes(Cached(_watch(store, redis_url, runs).look).get)
    server = listen(host, port, names, usual=METRICS_PORT, warn=partial(click.echo, err=True))
    serve(server, routes, lambda address: click.echo(f"{address}metrics"))


def _watch(store: str | Path, redis_url: str, runs: tuple[Path, ...]) -> FarmWatch:
    """The farm that the options name. Raises StoreError without a store."""
    from photonfarm.farm.running_farm import running_farm
    from photonfarm.farm.watch import FarmWatch
    from photonfarm.store import Store

    opened = Store(store)
    if not runs and running_farm(opened) is None:
        runs = (Path("run"),)
    return FarmWatch(opened, redis_url, runs, named_redis=names_redis())
