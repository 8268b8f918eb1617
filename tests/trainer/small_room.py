"""Small stores of a room, and runs of one step on them."""

from pathlib import Path

from photonfarm.plan.request import Request
from photonfarm.renderer.jobs.render import ShardRenderer
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneReader, Store
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings
from photonfarm.trainer.training.loop import train


def rendered(room: SceneSpec, folder: Path) -> Path:
    """A store of four samples of a room, each of another configuration, at 24 × 16 pixels."""
    changes = {
        "film": room.film.model_copy(update={"width": 24, "height": 16}),
        "transport": room.transport.model_copy(update={"half_spp": 1}),
        "photons": room.photons.model_copy(update={"paths": 512}),
        "points": 2048,
    }
    store = Store(folder / "store", create=True)
    scene = store.scene(store.plan(room.model_copy(update=changes), Request(modifications=4), shard_rows=4).scene_id)
    assert ShardRenderer(store, worker="test").render(scene.scene_id, 0)
    return Path(store.root)


def trained(store: Path, folder: Path, architecture: str, **of_network: object) -> Path:
    """A run of one step in a folder, on the only scene of a store."""
    (scene_id,) = Store(store).scene_ids()
    network = NetworkSettings.model_validate({"architecture": architecture, "width": 4, **of_network})
    settings = TrainSettings(network=network, max_steps=1, batch=2, hold_out=0.5, poll_seconds=0.01, threads=1)
    train(SceneReader(store, scene_id), settings, folder)
    return folder
