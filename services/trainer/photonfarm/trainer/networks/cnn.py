"""The baseline with no inputs but the image-space buffers."""

from __future__ import annotations

from photonfarm.trainer.networks.network import Network


class Cnn(Network):
    """Image synthesis from the image-space channels alone [supplement Table 1, "CNN only"]."""
