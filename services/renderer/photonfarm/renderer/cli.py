"""The verbs of the render service: doctor, preview, work."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from photonfarm.shared.cli import json_option, redis_option, store_option


@click.command()
@store_option
@redis_option
@json_option
def doctor(store: Path, redis_url: str, as_json: bool) -> None:
    """Try each part on this machine, and say what to do about what does not work."""
    from photonfarm.renderer.doctor import examine
    from photonfarm.shared import show

    sys.exit(show.findings(examine(store, redis_url), as_json))


@click.command()
@store_option
@redis_option
@click.option("--name", help="Name of this worker, distinct among all.  [default: host and process]")
@click.option("--scene", "scene_id", help="Work for this scene id alone.")
@click.option("--until-complete", is_flag=True, help="Stop when nothing is missing.")
@click.option("--check", is_flag=True, help="Only say whether a worker of this host is alive (exit 0) or not (7).")
def work(
    store: Path, redis_url: str, name: str | None, scene_id: str | None, until_complete: bool, check: bool
) -> None:
    """Render queued jobs into the store, on one core, until told to stop; start one per core."""
    from photonfarm.renderer import worker

    if check:
        worker.check(redis_url)
    else:
        worker.run_worker(store, redis_url, name=name, scene_id=scene_id, until_complete=until_complete)


@click.command()
@click.argument("spec")
@store_option
@click.option("--count", type=click.IntRange(1), default=24, show_default=True, help="Samples to show.")
@click.option("--out", type=click.Path(path_type=Path), default="preview.html", show_default=True)
def preview(spec: str, store: Path, count: int, out: Path) -> None:
    """Write a contact sheet of SPEC's samples: A, B, albedo, normal, depth, photons."""
    from photonfarm.renderer.preview import write_contact_sheet
    from photonfarm.shared.scene import load_spec
    from photonfarm.shared.store.reader import SceneReader

    write_contact_sheet(SceneReader(store, load_spec(spec).scene_id), count, out)
    click.echo(out)
