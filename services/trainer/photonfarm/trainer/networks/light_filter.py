"""A filter of noisy light by its own noise and by the surfaces that it falls on, and means over windows.

Shape letters: B batch, H W image, C channels.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

LEVELS = 3
"""The passes of the filter, with neighbours at 1, 2 and 4 pixels: it is fine after the first, coarse after the last."""


def estimate_variance(light: Tensor, reflects: Tensor) -> Tensor:
    """The variance of the mean colour from neighbours, (B, H, W, 1): of light over reflectance, as that is smooth.

    The square of a pixel less the mean over 3 × 3 is 8/9 of it, where nothing but noise differs.
    """
    rest = (light - reflects * smooth(light, reflects, 3)).mean(dim=-1, keepdim=True)
    return 9 / 8 * take_means(rest**2, 5)


def take_means(image: Tensor, size: int) -> Tensor:
    """The mean over windows of size × size pixels, cut at the border, (B, H, W, C)."""
    planes, reach = image.permute(0, 3, 1, 2).contiguous(), size // 2
    for window, padding in (((size, 1), (reach, 0)), ((1, size), (0, reach))):
        planes = functional.avg_pool2d(planes, window, stride=1, padding=padding, count_include_pad=False)
    return planes.permute(0, 2, 3, 1)


def smooth(light: Tensor, reflects: Tensor, size: int) -> Tensor:
    """Light over reflectance in windows, (B, H, W, 3): a ratio of sums, in which dark surfaces count the least."""
    both = take_means(torch.cat([light, reflects], dim=-1), size)
    return both[..., :3] / both[..., 3:]


def filter_light(light: Tensor, reflects: Tensor, variance: Tensor, normal: Tensor, places: Tensor) -> list[Tensor]:
    """Light filtered by its own noise and the surfaces, finely and coarsely, (B, H, W, 3) each.

    It is an à-trous filter (Dammertz et al., 2010) as a ratio of sums: neighbours, 3 × 3 at growing distances, count by
    Σ k w light / Σ k w reflectance. w falls with the angle of normals, the distance from the tangent plane, and the
    difference of brightness over its standard deviation, which goes from pass to pass (Schied et al., SVGF, 2017).
    """
    height, width = light.shape[1:3]
    weighted, weight = light, reflects.mean(dim=-1, keepdim=True).expand_as(light)
    weighted = weighted / reflects * weight
    variance, made = variance / weight[..., :1] ** 2, []
    for level in range(LEVELS):
        step = 1 << level
        value = weighted / weight
        bright = value.mean(dim=-1, keepdim=True)
        allowed = 4 * take_means(variance, 3).clamp(min=0).sqrt() + 1e-3
        packed = torch.cat([weighted, weight[..., :1], variance, bright, normal, places], dim=-1)
        around = functional.pad(packed.permute(0, 3, 1, 2), (step,) * 4, mode="replicate").permute(0, 2, 3, 1)
        sums = torch.zeros_like(packed[..., :5])
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                rows, columns = step * (1 + down), step * (1 + right)
                there = around[:, rows : rows + height, columns : columns + width]
                apart = 4 * (there[..., 6:9] - normal).square().sum(-1, keepdim=True)
                apart += (normal * (there[..., 9:12] - places)).sum(-1, keepdim=True).abs() / (0.01 * step)
                apart += (there[..., 5:6] - bright).abs() / allowed
                counts = 0.25 * 0.5 ** (abs(down) + abs(right)) * torch.exp(-apart)
                sums[..., :4] += counts * there[..., :4]
                sums[..., 4:] += (counts * there[..., 3:4]) ** 2 * there[..., 4:5]
        weighted, weight, variance = sums[..., :3], sums[..., 3:4].expand_as(light), sums[..., 4:] / sums[..., 3:4] ** 2
        made.append(reflects * weighted / weight)
    return [made[0], made[-1]]
