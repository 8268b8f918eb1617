"""What is gathered from photons in the image, against areas and radiance in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from read_batches import batch_of

from photonfarm.trainer.networks import ARCHITECTURES, build
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.networks.photon_map import WINDOWS, arrives_on_seen_side, gather_light, seen_area
from photonfarm.trainer.networks.projection import Footprint, Optics
from photonfarm.trainer.runs.settings import NetworkSettings

ARCHITECTURE = "light_transport_photons"
NEEDS = ARCHITECTURES[ARCHITECTURE].needs
B, H, W, K = 2, 24, 32, 40


@pytest.mark.parametrize("tilt", [0.0, 0.6, 1.2])
def test_the_area_that_a_pixel_sees_of_a_plane_is_that_between_its_corners(tilt: float) -> None:
    """The plane through (0, 0, 3) is turned about x; rays through the pixel's corners meet it at those of the area."""
    optics = Optics(focal_px=60.0, width=16, height=16, near=0.1, far=20.0)
    normal = np.array([0.0, math.sin(tilt), -math.cos(tilt)])

    def hits(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        rays = np.stack(np.broadcast_arrays((u - 8) / 60, (v[:, None] - 8) / 60, 1.0), axis=-1)
        return rays * (3 * normal[2] / (rays @ normal))[..., None]

    corners, centres = hits(np.arange(17.0), np.arange(17.0)), hits(np.arange(16) + 0.5, np.arange(16) + 0.5)
    diagonals = corners[1:, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, 1:]
    wanted = 0.5 * np.linalg.norm(np.cross(*diagonals), axis=-1)
    camera = torch.eye(3, 4, dtype=torch.float64)[None]
    depth = torch.from_numpy(centres[None, ..., 2])
    found = seen_area(optics, camera, depth, torch.from_numpy(normal).expand(1, 16, 16, 3))
    np.testing.assert_allclose(found[0], wanted, rtol=2e-3)
    assert torch.all(seen_area(optics, camera, torch.zeros_like(depth), torch.zeros(1, 16, 16, 3)) == 0)


def test_a_surface_seen_edge_on_is_left_out_with_what_lands_on_it() -> None:
    optics = Optics(focal_px=60.0, width=8, height=8, near=0.1, far=20.0)
    edge_on = torch.tensor([0.0, 1.0, -0.04]) / math.hypot(1, 0.04)
    camera, depth = torch.eye(3, 4)[None], torch.ones(1, 8, 8)
    area = seen_area(optics, camera, depth, edge_on.expand(1, 8, 8, 3))
    assert torch.all(area[0, 3:5, 3:5] == 0)
    kept = Footprint(point=torch.tensor([0]), pixel=torch.tensor([3 * 8 + 3]))
    assert all(torch.count_nonzero(found) == 0 for found in gather_light(torch.ones(1, 1, 3), kept, area))


def test_light_on_the_far_side_of_a_sheet_is_not_what_the_eye_sees() -> None:
    """An eye at (1, 2, 3), whatever way it looks; sheets before it, lit from its side and from behind."""
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0))).Q
    eye = torch.tensor([1.0, 2.0, 3.0])
    camera = torch.cat([rotation, -(rotation @ eye)[:, None]], dim=1)[None]
    away = torch.tensor([0.0, 0.0, 1.0])
    position = (eye + away).expand(1, 4, 3)
    direction, normal = torch.stack([away, -away, away, -away]), torch.stack([away, away, -away, -away])
    found = arrives_on_seen_side(position, direction[None], normal[None], camera)
    assert found.tolist() == [[True, False, True, False]]


@pytest.mark.parametrize(("max_depth", "counts"), [(-1, True), (4, True), (3, False)])
def test_photons_of_longer_paths_than_the_images_have_are_left_out(make_source, max_depth: int, counts: bool) -> None:
    """A photon that met two surfaces before its own has come over three edges, and the eye's is the fourth."""
    source = make_source(1, photons=256)
    settings = NetworkSettings(width=4, architecture=ARCHITECTURE)
    frame = replace(SceneFrame.of(source.spec, *source.base(), settings), max_depth=max_depth)
    network, inputs = build(settings, frame, 0), batch_of(source, (0,), NEEDS).inputs
    inputs.photons.bounce.masked_fill_(inputs.photons.present, 2)
    with torch.no_grad():
        assert any(found.any() for found in network.photon_light(inputs)) == counts


def box(pixels: int, beside: int) -> np.ndarray:
    """Which pixels of a row are within so many of each."""
    return (np.abs(np.subtract.outer(np.arange(pixels), np.arange(pixels))) <= beside).astype(float)


def test_flux_and_area_are_summed_over_the_same_pixels() -> None:
    """Photon by photon, and three boxes as matrices along each axis; where no surface is near there is nothing."""
    torch.manual_seed(0)
    power, area = torch.rand(B, K, 3, dtype=torch.float64), torch.rand(B, H, W, dtype=torch.float64)
    area[:, :, :20] = 0
    lands = torch.randperm(B * K)[:50]
    kept = Footprint(point=lands, pixel=lands // K * (H * W) + torch.randint(H * W, (50,)))
    flux = np.zeros((B * H * W, 3))
    for point, pixel in zip(kept.point.tolist(), kept.pixel.tolist(), strict=True):
        flux[pixel] += power.view(-1, 3)[point].numpy()
    flux = flux.reshape(B, H, W, 3) * (area.numpy() > 0)[..., None]
    besides = [max(round(0.5 * (share * W - 1)), 1) for share in WINDOWS]
    assert besides == [1, 2]
    for found, beside in zip(gather_light(power, kept, area), besides, strict=True):
        along_v, along_u = (np.linalg.matrix_power(box(n, beside), 3) for n in (H, W))
        summed = np.einsum("vy,ux,byxc->bvuc", along_v, along_u, flux)
        seen = np.einsum("vy,ux,byx->bvu", along_v, along_u, area.numpy())[..., None]
        with np.errstate(divide="ignore", invalid="ignore"):
            wanted = np.where(seen > 0, summed / seen / math.pi, 0)
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-12)
        assert (seen == 0).any()
        assert (seen > 0).any()


def test_what_is_gathered_is_the_light_of_diffuse_surfaces_and_the_image_before_anything_is_learned(
    make_source,
) -> None:
    """Clean images of direct light in closed form agree with it in sums over the image, and the wider window is near.

    Photons are noisy, and the light quad, whose albedo is 0, is in none of it.
    """
    source = make_source(12, size=32, photons=32768, exposure=3.0)
    settings = NetworkSettings(width=4, architecture=ARCHITECTURE)
    network = build(settings, SceneFrame.of(source.spec, *source.base(), settings), 0)
    found, wanted = [], []
    for row in range(12):
        inputs = batch_of(source, (row,), NEEDS).inputs
        with torch.no_grad():
            known = network.known(inputs, network.further(inputs))
            torch.testing.assert_close(known, inputs.albedo * network.photon_light(inputs)[1])
        diffuse = inputs.albedo[0].sum(dim=-1).numpy() > 0
        found.append(known[0].numpy()[diffuse])
        wanted.append(source.spec.exposure * source.clean(row)[diffuse])
    image, clean = np.concatenate(found), np.concatenate(wanted)
    assert image.mean() == pytest.approx(clean.mean(), rel=0.05)
    assert np.mean((image - clean) ** 2) < 0.1 * np.mean(clean**2)
