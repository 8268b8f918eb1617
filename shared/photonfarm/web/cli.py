"""The verb `web`."""

from __future__ import annotations

import logging
import signal
import sys
from pathlib import Path

import click

from photonfarm.shared.cli.options import names_redis, redis_option, store_option
from photonfarm.shared.farm.running_farm import WEB_PORT


@click.command()
@store_option
@redis_option
@click.option(
    "--run",
    "runs",
    type=click.Path(path_type=Path, file_okay=False),
    multiple=True,
    help="Folder of a training run; may be repeated.  [default: that of an `up` at work here, or run]",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=WEB_PORT,
    show_default=True,
    help="If it is taken, a free one is taken instead.",
)
@click.option(
    "--host",
    default="localhost",
    show_default=True,
    help="The address to listen on; whoever reaches any other one sees all that the store holds.",
)
@click.option(
    "--name", "names", multiple=True, help="A name, beside the host's, by which browsers may ask; may be repeated."
)
def web(
    store: str | Path, redis_url: str, runs: tuple[Path, ...], port: int, host: str, names: tuple[str, ...]
) -> None:  # fmt: skip
    """Serve pages that show the farm while it works: samples, noise, queue, workers, training, predictions.

    They only read, and fetch nothing from elsewhere. Ends on Ctrl-C.
    """
    from photonfarm.shared.core.errors import StoreError
    from photonfarm.shared.core.processes import free_port
    from photonfarm.shared.farm.running_farm import running_farm
    from photonfarm.shared.farm.watch import FarmWatch
    from photonfarm.shared.store import Store
    from photonfarm.web.farm_pages import FarmPages
    from photonfarm.web.server import PageServer

    logging.basicConfig(format="%(asctime)s %(name)s: %(message)s", stream=sys.stderr)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    opened = Store(store)
    if not runs and running_farm(opened) is None:
        runs = (Path("run"),)
    pages = FarmPages(store, FarmWatch(opened, redis_url, runs, named_redis=names_redis()))
    try:
        server = PageServer(pages, host, free_port(port), names)
    except OSError as error:
        raise StoreError(f"--host {host} --port {port}: cannot listen there: {error.strerror}") from error
    with server:
        click.echo(f"http://{host}:{server.server_address[1]}/")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return
