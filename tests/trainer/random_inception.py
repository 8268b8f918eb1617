"""A network with the blocks of the Inception of FID, small and without its weights."""

import torch

from photonfarm.trainer.metrics.features import Inception, InceptionWeights


def random_inception() -> Inception:
    """Seeded random weights, as loud as trained ones."""
    torch.manual_seed(0)
    widths = {"pool0": (3, 64), "pool1": (64, 192), "mixed_7": (192, 768), "mixed_10": (768, 2048)}
    network = torch.nn.Sequential()
    for name, (width_in, width) in widths.items():
        convolution = torch.nn.Conv2d(width_in, width, 3, stride=4)
        torch.nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
        network.add_module(name, torch.nn.Sequential(convolution, torch.nn.ReLU()))
    return Inception(network.requires_grad_(requires_grad=False), InceptionWeights("seeded", "0" * 64, published=False))
