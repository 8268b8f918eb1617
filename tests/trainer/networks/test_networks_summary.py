"""The parameters and the work of each part of a network, as counted and as worked out by hand."""

import pytest

from photonfarm.scene.spec import SceneSpec
from photonfarm.scene.spec_loading import load_spec
from photonfarm.trainer.networks.summary import NetworkPart, format_summary, summarise
from photonfarm.trainer.runs.settings import NetworkSettings


def spec_of(size: int, points: int = 16384) -> SceneSpec:
    film = {"width": size, "height": size}
    spec = load_spec("room").model_dump() | {"film": film, "points": points, "photons": {"paths": 512, "depth": 4}}
    return SceneSpec.model_validate(spec)


def parts(size: int = 64, points: int = 16384, **settings: object) -> dict[str, NetworkPart]:
    return {part.name: part for part in summarise(spec_of(size, points), NetworkSettings(**settings))}


def test_the_papers_network_has_its_published_size_and_work() -> None:
    found = parts(size=256)
    assert found["U-Net"].parameters == 11_734_467  # 11.7 M [method 2]
    assert found["U-Net"].gmacs == pytest.approx(62.1, abs=0.05)  # 62 GMAC at 256²


def test_the_work_of_a_u_net_grows_with_its_pixels_and_with_the_square_of_its_width() -> None:
    by_width = [parts(width=width, architecture="cnn")["U-Net"].gmacs for width in (64, 128)]
    assert by_width[1] == pytest.approx(4 * by_width[0], rel=0.02)
    assert parts(size=128, architecture="cnn")["U-Net"].gmacs == pytest.approx(4 * by_width[0], rel=1e-6)


def test_the_point_branch_is_the_one_of_figure_1() -> None:
    """Each point goes 56 → 64 and two blocks of 64 → 32 twice and 32 → 32; the maximum's half is worked once a cloud.

    Of its 56 numbers the 15 of the position change; 9 others, 32 of the descriptor and the first layer's bias are the
    same in all samples, worked once.
    """
    found = parts()["point branch"]
    assert found.parameters == 16384 * 32 + (56 * 64 + 64) + 2 * (64 * 32 + 32 + 32 * 32 + 32 + 64 * 32)
    first_block = 64 * 32 + 32 * 32 + 64 * 32
    second_block = 32 * 32 + 32 * 32 + 32 * 32
    per_point = 56 * 64 + first_block + second_block
    assert found.gmacs == pytest.approx((16384 * per_point + 2 * 32 * 32) / 1e9, rel=1e-6)


def test_photons_may_have_a_branch_of_their_own() -> None:
    without, gathered = parts(), parts(architecture="light_transport_photons")
    assert gathered.keys() == without.keys()
    assert gathered["U-Net"].parameters - without["U-Net"].parameters == 6 * 64 * 9
    found = parts(architecture="light_transport_photons", photons="transport")
    assert found["photon branch"].parameters == (25 * 64 + 64) + 2 * (64 * 32 + 32 + 32 * 32 + 32 + 64 * 32)
    assert found["point branch"] == without["point branch"]
    assert found["U-Net"].parameters - without["U-Net"].parameters == 64 * 64 * 9  # channels more


def test_the_denoiser_is_light() -> None:
    whole, light = parts(architecture="cnn")["U-Net"], parts(architecture="denoise_16")["U-Net"]
    assert 0.2 < light.gmacs / whole.gmacs < 0.3
    assert parts(architecture="denoise_16") == parts(architecture="denoise_1")


def test_the_points_set_are_those_counted() -> None:
    found = parts(points=4096, architecture="feature_projection")["point branch"]
    assert found == NetworkPart("point branch", 4096 * 32, 0.0)
    assert parts(points=100)["point branch"].parameters < parts(points=101)["point branch"].parameters


def test_the_table_ends_with_the_sum() -> None:
    lines = format_summary([NetworkPart("point branch", 1000, 0.25), NetworkPart("U-Net", 2_000_000, 1.0)]).splitlines()
    assert lines[0].split() == ["part", "parameters", "GMAC"]
    assert lines[2].split() == ["U-Net", "2,000,000", "1.000"]
    assert lines[3].split() == ["total", "2,001,000", "1.250"]
