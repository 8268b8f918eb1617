"""A job on a card against a job on a processor, in one store: by the block z-test. Jobs are rendered by the verb, in
processes of their own; what needs an NVIDIA card is skipped without one.
"""

import json
import subprocess
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonfarm.core.processes import command
from photonfarm.core.statistics import block_z_test
from photonfarm.farm.devices import cards_here
from photonfarm.plan.request import Request
from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.store import SceneReader, SceneStore, Store
from photonfarm.store.check.check import check_store

PASSES = 8


def on_card(*arguments: str) -> Any:
    return pytest.param(
        *arguments, marks=pytest.mark.skipif(bool(cards_here().trouble), reason=cards_here().trouble or "a card")
    )


def rendered(scene: SceneStore, job: int, device: str) -> np.ndarray:
    """The halves of a job's passes (2 · PASSES, H, W, 3), rendered on a device."""
    store = scene.folder.parent.parent
    verb = ["work", "--store", str(store), "--scene", scene.scene_id, "--job", str(job), "--device", device]
    subprocess.run(command(*verb), check=True, capture_output=True, timeout=300)
    reader = SceneReader(store, scene.scene_id)
    reader.refresh()
    rows = [sample.row for sample in scene.job_rows(job).samples]
    return np.concatenate([reader.read(row).radiance for row in rows])


@pytest.mark.parametrize(("device", "name"), [("cpu", "cornell"), on_card("cuda", "cornell"), on_card("cuda", "room")])
def test_jobs_on_two_devices_agree_within_chance(
    device: str, name: str, store: Store, small: Callable[..., SceneSpec]
) -> None:
    spec = small(load_spec(name), width=32, height=32, half_spp=8)
    request = Request(modifications=1, views_per_modification=1, passes=2 * PASSES)
    scene = store.scene(store.plan(spec, request, shard_rows=PASSES).scene_id)
    images = rendered(scene, 0, "cpu"), rendered(scene, 1, device)
    test = block_z_test(*images, blocks=4)
    assert test.finite
    assert test.z_max < test.z_limit, (test.z_max, test.mean_ratio)
    figures = [json.loads((scene.folder / f"committed/{job:012d}.json").read_text())["figures"] for job in (0, 1)]
    assert figures[0]["device"] == "cpu"
    assert (figures[1]["device"] == "cpu") == (device == "cpu")
    assert bool(figures[1]["driver"]) == (device != "cpu")
    assert check_store(store, when="2026-01-01T00:00:00Z").exit_code == 0


@pytest.mark.parametrize("device", [on_card("cuda")])
def test_a_pass_of_a_card_made_again_on_a_processor_differs_by_no_more_than_chance(
    device: str, store: Store, small: Callable[..., SceneSpec]
) -> None:
    spec = small(load_spec("room"), width=32, height=32, half_spp=8)
    scene = store.scene(store.plan(spec, Request(modifications=1), shard_rows=1).scene_id)
    rendered(scene, 0, device)
    verb = ["render", scene.scene_id, "--store", str(store.root), "--row", "0", "--device", "cpu", "--json"]
    done = subprocess.run(command(*verb), check=False, capture_output=True, text=True, timeout=300)
    assert done.returncode in (0, 1), done.stderr
    assert json.loads(done.stdout)["stored"]["devices"][1] == "cpu"
