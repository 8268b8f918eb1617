"""The verbs `web` and `serve-metrics`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from photonfarm.cli.options import address_options, combine_options, names_redis, redis_option, store_option
from photonfarm.farm.running_farm import METRICS_PORT, WEB_PORT

if TYPE_CHECKING:
    from photonfarm.farm.watch import FarmWatch


_watch_options = combine_options(
    store_option,
    redis_option,
    click.option(
        "--run",
        "runs",
        type=click.Path(path_type=Path, file_okay=False),
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
    default=WEB_PORT,
    show_default=True,
    help="If it is taken, a free one is taken instead.",
)
def web(store: str | Path, redis_url: str, runs: tuple[Path, ...], **where: Any) -> None:
    """Serve pages that show the farm while it works: samples, noise, queue, workers, training, predictions.

    They only read, and fetch nothing from elsewhere. /metrics is for Prometheus. Ends on Ctrl-C.
    """
    from photonfarm.core.processes import free_port
    from photonfarm.web.farm_pages import FarmPages
    from photonfarm.web.server import make_page_routes, serve

    pages = FarmPages(store, _watch(store, redis_url, runs))
    serve(make_page_routes(pages), say=click.echo, **where | {"port": free_port(where["port"])})


@click.command("serve-metrics")
@_watch_options
@click.option("--port", type=click.IntRange(0, 65535), default=METRICS_PORT, show_default=True, help="0: a free one.")
def serve_metrics(store: str | Path, redis_url: str, runs: tuple[Path, ...], **where: Any) -> None:
    """Serve /metrics for Prometheus: samples, core time, queue, workers, failures, training.

    `web` serves the same beside its pages. Ends on Ctrl-C.
    """
    from photonfarm.web.images import Cached
    from photonfarm.web.server import make_metric_routes, serve

    serve(
        make_metric_routes(Cached(_watch(store, redis_url, runs).look).get),
        say=lambda address: click.echo(f"{address}metrics"),
        **where,
    )


def _watch(store: str | Path, redis_url: str, runs: tuple[Path, ...]) -> FarmWatch:
    """The farm that the options name. Raises StoreError without a store."""
    from photonfarm.farm.running_farm import running_farm
    from photonfarm.farm.watch import FarmWatch
    from photonfarm.store import Store

    opened = Store(store)
    if not runs and running_farm(opened) is None:
        runs = (Path("run"),)
    return FarmWatch(opened, redis_url, runs, named_redis=names_redis())
