"""The time of a frame in a report: which parts of it a predictor needs, and what is said where none is known."""

from dataclasses import replace

import numpy as np
import pytest

from photonfarm.core.archives import PARTS, FrameCosts, Seconds
from photonfarm.trainer.predictors.trained import ReadyPredictor, TrainedRun
from photonfarm.trainer.report import write_report
from photonfarm.trainer.report.frame_times import assemble_frame_time, count_points


def test_frames_are_timed_where_the_renderer_can_and_else_it_is_said_why(measured, tmp_path) -> None:
    """The renderer does not know the analytic scene, and ends with an error."""
    figures = write_report(measured.store, measured.runs[:1], tmp_path / "out")
    assert figures["evaluation"]["rows"][0]["frame_seconds"] is None
    assert "`photonfarm measure-frames` ended with exit code" in (tmp_path / "out/report.html").read_text()


def test_the_time_of_a_frame_is_that_of_the_parts_which_a_predictor_needs(measured) -> None:
    transport, denoiser = measured.runs
    parts = {
        name: np.array([seconds]) for name, seconds in zip(PARTS, (9.0, 0.1, 0.7, 1.6, 0.2, 0.4, 0.8), strict=True)
    }
    surface = np.zeros((1, 8, 8), np.uint8)
    amounts = {"kept": np.array([1, 4, 1]), "halves": np.array([1, 1, 8]), "render_s": np.array([[5.0], [2.0], [30.0]])}
    costs = FrameCosts("0" * 32, np.array([3]), surface, **parts, **amounts)
    network = Seconds(1.0, 0.9, 1.1)
    assert assemble_frame_time(TrainedRun.load(transport), network, costs).total == pytest.approx(1.0 + 0.1 + 0.2)
    of_denoiser = assemble_frame_time(TrainedRun.load(denoiser), network, costs)
    assert of_denoiser.total == pytest.approx(1.0 + 0.1 + 2.0)
    assert of_denoiser.document()["ranges"] == {"render": [2.0, 2.0], "buffers": [0.1, 0.1], "network": [0.9, 1.1]}
    settings = TrainedRun.load(transport).settings
    for ready, seconds in (
        (ReadyPredictor("none", 1, settings), 1.0 + 5.0),  # which reads no buffers
        (ReadyPredictor("oidn", 1, settings, halves=8), 1.0 + 0.1 + 30.0),
        (ReadyPredictor("oidn-reflectance", 4, settings), 1.0 + 0.7 + 2.0),
    ):
        assert assemble_frame_time(ready, network, costs).total == pytest.approx(seconds)
    of_halves = settings.network.model_copy(update={"architecture": "guided_denoise"})
    several = replace(TrainedRun.load(transport), settings=settings.model_copy(update={"network": of_halves}), halves=8)
    assert assemble_frame_time(several, network, costs).total == pytest.approx(1.0 + 1.6 + 30.0)
    with_photons = replace(
        TrainedRun.load(transport),
        settings=settings.model_copy(
            update={"network": settings.network.model_copy(update={"architecture": "light_transport_photons"})}
        ),
    )
    assert assemble_frame_time(with_photons, network, costs).total == pytest.approx(1.0 + 0.1 + 0.2 + 0.4 + 0.8)


def test_points_are_charged_as_many_as_a_network_uses(measured) -> None:
    transport, denoiser = measured.runs
    runs = [TrainedRun.load(transport), TrainedRun.load(denoiser)]
    assert count_points(runs) is count_points(runs[1:]) is None, "it uses all, or there is none that uses any"

    def with_points(count: int) -> TrainedRun:
        settings = runs[0].settings
        network = settings.network.model_copy(update={"points": count})
        return replace(runs[0], settings=settings.model_copy(update={"network": network}))

    assert count_points([with_points(64), with_points(128), runs[1]]) == 128
