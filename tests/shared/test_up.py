"""What `photonfarm up` says of how far it is."""

from pathlib import Path

import store_samples as samples

from photonfarm.shared.cli.show_up import progress_line
from photonfarm.shared.farm import up
from photonfarm.shared.plan.request import Request
from photonfarm.shared.plan.top_up import TopUp
from photonfarm.shared.store import Store


def test_further_passes_are_told_apart_from_samples(store: Store, tmp_path: Path) -> None:
    scene = store.scene(store.plan(samples.small_spec(), Request(modifications=3, passes=2), shard_rows=4).scene_id)
    farm = up._Farm(scene, tmp_path, 10)
    assert farm.look() == up.FarmProgress((0, 6), (0, 0), 0, 10, "")
    assert progress_line(farm.look()) == "samples 0/6  steps 0/10"
    scene.plan(TopUp.of("+24", ["views=first:2"]))  # three passes of 8 samples per pixel each
    samples.commit(scene, 0, samples.outputs(scene, 0))
    assert (farm.look().samples, farm.look().passes) == ((4, 6), (0, 6))
    samples.commit(scene, 2, samples.outputs(scene, 2))
    assert (farm.look().samples, farm.look().passes) == ((4, 6), (4, 6))
    assert progress_line(farm.look()) == "samples 4/6  further passes 4/6  steps 0/10"
