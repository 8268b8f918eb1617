"""Light that lit points of the scene's cloud send on, by instant radiosity [Keller 1997] with learned visibility.

Each of the first points of the cloud stands for its share A of the scene's surface. It receives direct light E,
rendered with its shadows. What it reflects, ρ E / π, goes to every pixel by the form factor
F = cos θ cos θ′ A / (π r²):

light of a pixel = Σ F V ρ E / π

This is attention over points. Its kernel is the form factor, so that the light of a pixel depends on its position,
which a maximum over points cannot express. The visibility V between two surfaces is learned, as a function of their
places and normals:

V = sigmoid(r(receiver) · s(sender) + b)

For metals the light is summed over the directions that their lobe reflects; nothing is learned there. Light that points
send to each other was tried, and brings nothing at equal time (docs/results/networks.md).

Shape letters: B batch, L lit points, H W image, N receivers, Q tiles of glossy pixels, C numbers of a surface.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from photonfarm.core.records import LIT_POINTS
from photonfarm.trainer.networks.inputs import GuideInputs, Inputs, SceneFrame, require
from photonfarm.trainer.networks.network import add_octaves

COARSE = 4
"""The side, in pixels, of the squares for which diffuse light is summed: it changes little between neighbours."""

SHARPEST = 0.075
"""The least roughness of a glossy lobe: a narrower lobe would fall between points."""

LEAST_LOGARITHM = -60.0
"""The least logarithm of a lobe's values, as processors multiply denormal numbers about four times more slowly."""

TOGETHER = 32
"""The pixels of one tile: those glossy ones of one sample whose lobes are summed by one product of matrices."""

CHANNELS = 9
"""The channels of the three results of `LitPoints` together."""

PATH_EDGES = 3
"""The edges of the paths that lit points stand for: from a lamp to a point, to a surface, to the eye."""

DIFFUSE = 1
"""The index of all diffuse light among the results of `LitPoints`."""

OCTAVES = 3
"""The number of frequencies that encode a position."""

HIDDEN = 64
"""The width of the hidden layer of the visibility networks."""

FACTORS = 8
"""The length of the vectors r and s, whose product gives the visibility between two surfaces."""

OPEN = 2.0
"""The initial value of b, by which most surfaces see each other before anything is learned."""


class LearnedVisibility(nn.Module):
    """The learned visibility between two surfaces, in (0, 1)."""

    def __init__(self, frame: SceneFrame) -> None:
        """Take the scene's size from a frame."""
        super().__init__()
        self._scale = frame.scale
        self.receiver, self.sender = _factors(std=0.3 / HIDDEN**0.5), _factors()
        self.open = nn.Parameter(torch.tensor(OPEN))

    def surfaces(self, position: Tensor, normal: Tensor) -> Tensor:
        """The features of surfaces: their places, in sines and cosines, and their normals, (…, N, C)."""
        return torch.cat([add_octaves(position / self._scale, OCTAVES), normal], dim=-1)

    def forward(self, receivers: Tensor, senders: Tensor) -> Tensor:
        """The visibility of each sender from each receiver, (B, N, C) and (B, L, C) → (B, N, L)."""
        logits = torch.baddbmm(self.open, self.receiver(receivers), self.sender(senders).mT)
        return logits.sigmoid_()


def _factors(std: float | None = None) -> nn.Sequential:
    """A network from a surface's features to its factors; `std` is the initial deviation of its last weights."""
    last = nn.Linear(HIDDEN, FACTORS)
    if std is not None:
        nn.init.normal_(last.weight, std=std)
        nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(6 + 6 * OCTAVES, HIDDEN), nn.ReLU(), last)


class LitPoints(nn.Module):
    """The radiance of white diffuse surfaces, and of lobes over their albedo, by the light of lit points.

    All positions within are about the scene's centre, as squares of large coordinates leave float32 no distances. Other
    kinds override `form_factors` or `arriving`.
    """

    centre: Tensor
    albedo: Tensor
    normal: Tensor

    def __init__(self, frame: SceneFrame, count: int) -> None:
        """Take the first `count` points of a frame's cloud, or all that are lit if these are fewer."""
        super().__init__()
        self._optics, self._max_depth, self._turns = frame.optics, frame.max_depth, frame.changes
        self._count = min(count, len(frame.appearance), LIT_POINTS)
        self._area = frame.area / self._count
        self.visibility = LearnedVisibility(frame)
        self.register_buffer("centre", torch.from_numpy(frame.centre), persistent=False)
        self.register_buffer("normal", torch.from_numpy(frame.appearance[: self._count, 0:3].copy()), persistent=False)
        self.register_buffer("albedo", torch.from_numpy(frame.appearance[: self._count, 3:6].copy()), persistent=False)

    def forward(self, inputs: Inputs) -> list[Tensor]:
        """Diffuse light if nothing hid a point, diffuse light, and light by other lobes, (B, H, W, 3) each.

        The last is 0 where other lobes reflect less than `inputs.GLOSSY`.
        """
        points, guides = require(inputs.points), require(inputs.guides)
        source, there = points.position[:, : self._count] - self.centre, points.present[:, : self._count, None]
        if self._turns:
            source = torch.cat([source, require(points.normal)[:, : self._count]], dim=-1)
        sent = self.albedo * there * guides.point_light[:, : self._count] / math.pi
        if 0 <= self._max_depth < PATH_EDGES:
            sent = torch.zeros_like(sent)
        surfaces = self._surfaces(inputs)
        unhidden, light = self._diffuse(*surfaces[1:], source, sent)
        return [unhidden, light, self._gloss(inputs, surfaces, source, sent)]

    def _surfaces(self, inputs: Inputs) -> tuple[Tensor, Tensor, Tensor]:
        """The ray, position and normal of each pixel's surface, (B, H, W, 3) each."""
        guides, to_camera = require(inputs.guides), inputs.world_to_camera
        rays = self._optics.rays(to_camera, inputs.focal_px)
        eye = -(to_camera[:, :, :3].mT @ to_camera[:, :, 3:]).mT - self.centre
        distance = guides.mean_depth / (rays * to_camera[:, None, None, 2, :3]).sum(-1)
        at = eye[:, None] + rays * distance[..., None]
        return rays, at, functional.normalize(guides.mean_normal, dim=-1)

    def _diffuse(self, surface: Tensor, normal: Tensor, source: Tensor, sent: Tensor) -> tuple[Tensor, Tensor]:
        """The points' light without and with learned visibility, (B, H, W, 3) each."""
        at, facing = (_pool(image).flatten(1, 2) for image in (surface, normal))
        arriving = torch.cat(self.arriving(at, functional.normalize(facing, dim=-1), source, sent), dim=-1)
        height, width = surface.shape[1] // COARSE, surface.shape[2] // COARSE
        coarse = arriving.view(-1, height, width, 6).permute(0, 3, 1, 2)
        fine = functional.interpolate(coarse, scale_factor=COARSE, mode="bilinear").permute(0, 2, 3, 1)
        return fine[..., :3], fine[..., 3:]

    def arriving(self, at: Tensor, facing: Tensor, source: Tensor, sent: Tensor) -> tuple[Tensor, Tensor]:
        """Light without and with learned visibility at surfaces (B, N, 3) with normals `facing`, (B, N, 3) each.

        The points are at `source`, (B, L, 3), or (B, L, 6) with normals of their own, and send so much, (B, L, 3).
        """
        factors, surfaces = self.form_factors(at, facing, source), self.visibility.surfaces
        senders = surfaces(*self._split(source))
        seen = factors * self.visibility(surfaces(at, facing), senders)
        return factors @ sent, seen @ sent

    @torch.no_grad()
    def form_factors(self, at: Tensor, facing: Tensor, source: Tensor) -> Tensor:
        """cos θ cos θ′ A / (π r²) between surfaces (B, N, 3) with normals `facing` and each point, (B, N, L)."""
        leaves, squared = self._between(at, source)
        cosines = _measure_along(facing, at, self._split(source)[0]).clamp_(min=0).mul_(leaves)
        return cosines.div_(squared.square_()).mul_(self._area / math.pi)

    @torch.no_grad()
    def _gloss(self, inputs: Inputs, surfaces: tuple[Tensor, Tensor, Tensor], source: Tensor, sent: Tensor) -> Tensor:
        """Light by other lobes, (B, H, W, 3), summed for glossy pixels alone, as these are few."""
        guides = require(inputs.guides)
        pixel, slot, sample = _list_glossy(guides)
        places = pixel.new_zeros(len(sample) * TOGETHER).index_copy_(0, slot, pixel)  # what is left over is not used
        images = (image.flatten(0, 2).index_select(0, places) for image in (*surfaces, guides.roughness[..., None]))
        rays, at, normal, roughness = (image.view(-1, TOGETHER, image.shape[-1]) for image in images)
        light = self._lobes(at, normal, rays, roughness, source.index_select(0, sample), sent.index_select(0, sample))
        gloss = torch.zeros_like(guides.specular)
        gloss.flatten(0, 2).index_copy_(0, pixel, light.flatten(0, 1).index_select(0, slot))
        return gloss

    def _lobes(
        self, at: Tensor, normal: Tensor, rays: Tensor, roughness: Tensor, source: Tensor, sent: Tensor
    ) -> Tensor:
        """The mean of the points' light over a lobe about the mirrored ray, (Q, N, 3), of roughness (Q, N, 1).

        The lobe is a von Mises–Fisher distribution; each point has the weight of its solid angle. Its κ is 1 / (2 α²):
        Beckmann's normals of roughness α have 2 / α² about the surface's normal, and mirroring doubles their angles.
        """
        mirrored = rays - 2 * (rays * normal).sum(-1, keepdim=True) * normal
        sharpness = 0.5 / roughness.clamp(min=SHARPEST) ** 2
        leaves, squared = self._between(at, source)
        nearness = squared.rsqrt_()  # 1 / r
        weight = _measure_along(sharpness * mirrored, at, self._split(source)[0]).mul_(nearness).sub_(sharpness)
        weight.clamp_(min=LEAST_LOGARITHM).exp_().mul_(leaves).mul_(nearness.pow_(3))
        light, total = torch.split(weight @ functional.pad(sent, (0, 1), value=1.0), [3, 1], dim=-1)
        return light / total.clamp(min=1e-12)

    def _between(self, at: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
        """Distance × cosine at each point's front, at least 0, and the squared distance, (B, N, L) each.

        The square is at least a point's area over π, so that no near point outweighs all others.
        """
        with_one, (place, normal) = functional.pad(at, (0, 1), value=1.0), self._split(source)
        behind = -(place * normal).sum(-1, keepdim=True)
        leaves = with_one @ torch.cat([normal, behind], dim=-1).mT
        squares = torch.cat([-2 * place, (place * place).sum(-1, keepdim=True)], dim=-1)
        squared = torch.baddbmm((at * at).sum(-1, keepdim=True), with_one, squares.mT)
        return leaves.clamp_(min=0), squared.clamp_(min=self._area / math.pi)

    def _split(self, source: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and normals (B, L, 3) of points, which have normals of their own or those of the base."""
        place, normal = source[..., :3], source[..., 3:]
        return place, normal if normal.shape[-1] else self.normal.expand_as(place)


def _measure_along(direction: Tensor, at: Tensor, source: Tensor) -> Tensor:
    """direction · (source − at) of surfaces (B, N, 3) and points (B, L, 3), (B, N, L)."""
    return torch.baddbmm(-(direction * at).sum(-1, keepdim=True), direction, source.mT)


def _list_glossy(guides: GuideInputs) -> tuple[Tensor, Tensor, Tensor]:
    """The glossy pixels of a batch, and tiles for them, each for pixels of one sample.

    The pixels (K,) of B·H·W, their places (K,) in Q · `TOGETHER`, and the sample of each tile, (Q,). Where they are
    counted already, nothing is waited for.
    """
    glossy = guides.find_glossy().flatten(1)
    count = glossy.sum(dim=1)
    known = count if guides.glossy_count is None else guides.glossy_count
    pixels, all_tiles = int(known.sum()), int(_count_tiles(known).sum())
    pixel = torch.nonzero_static(glossy.flatten(), size=pixels).flatten()
    tiles = _count_tiles(count)
    shift = (tiles.cumsum(0) - tiles) * TOGETHER - (count.cumsum(0) - count)
    place = torch.arange(pixels, device=pixel.device) + shift.index_select(0, pixel // glossy.shape[1])
    samples = torch.arange(len(count), device=count.device)
    return pixel, place, samples.repeat_interleave(tiles, output_size=all_tiles)


def _count_tiles(pixels: Tensor) -> Tensor:
    return (pixels + (TOGETHER - 1)) // TOGETHER


def _pool(image: Tensor) -> Tensor:
    """Means over squares of pixels, (B, H, W, 3) → (B, H/4, W/4, 3)."""
    return functional.avg_pool2d(image.permute(0, 3, 1, 2), COARSE).permute(0, 2, 3, 1)
