"""Steps and images of every network are timed, those with guides too."""

import pytest

from bench.trainer.train_step import WHOLE, WorkTimer, filled, for_architecture, measure, resized, shown
from photonfarm.trainer.runs.settings import make_preset


@pytest.mark.slow
def test_every_network_takes_its_steps_and_its_parts_are_timed(tmp_path) -> None:
    where = tmp_path, filled(resized(16, 64), tmp_path, 32)
    settings = make_preset("small", network={"width": 4, "points": 64})
    chosen = ("light_transport_photons", "guided_transport_photons", "guided_denoise", "denoise_4")
    assert set(chosen) <= set(shown())
    timed = [measure(where, for_architecture(settings, name), WorkTimer("cpu", 1), 2) for name in chosen]
    for row in timed:
        assert WHOLE not in row.step_parts_ms
        assert row.step_parts_ms["U-Net"] > 0 < row.image_parts_ms["U-Net"]
        assert row.step_ms > 0 < row.read_ms
