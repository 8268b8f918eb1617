"""What can be set about training, with each default and its reason; light to import (no torch).

Where a default is the supplement's, its section is named; the others are ours.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

DepthSpace = Literal["window", "linear", "relative"]
Architecture = Literal["light_transport", "cnn"]
Loss = Literal["linear", "relative"]

Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class NetworkSettings(_Frozen):
    """The network; changing any of these makes another network, and old checkpoints are refused."""

    architecture: Architecture = "light_transport"
    width: Annotated[int, Field(ge=1, le=512)] = 64  # d of the image synthesis layer [S Fig. 2]
    points: Count | None = None  # first points of the base cloud to use; None: all of them
    descriptor: Annotated[int, Field(ge=0, le=512)] = 32  # learnable numbers per point
    depth_space: DepthSpace = "window"  # where the occlusion tolerance is measured
    occlusion_tolerance: Positive = 1e-3  # [S 1.2]


class TrainSettings(_Frozen):
    """A training run."""

    network: NetworkSettings = NetworkSettings()
    seed: Annotated[int, Field(ge=0, lt=1 << 32)] = 0

    loss: Loss = "linear"  # [S 3.2]; "relative" is ours, for lamps in view; both are unbiased
    batch: Count = 32  # [S 3.1: 32 dynamic, 128 static]
    learning_rate: Positive = 5e-4  # [S 3.1]
    decay: Annotated[float, Field(gt=0, le=1)] = 0.99  # of the rate, per epoch [S 3.1]
    epoch_samples: Count = 50_000  # an epoch counts samples drawn, so the schedule ignores how much has arrived
    beta1: Annotated[float, Field(ge=0, lt=1)] = 0.9
    beta2: Annotated[float, Field(ge=0, lt=1)] = 0.999  # nearer 1 under rare fireflies, which darken Adam [method 3]

    max_steps: Count = 150_000  # [S 4]
    max_seconds: Positive | None = None  # wall time of all sessions of the run together

    hold_out: Annotated[float, Field(gt=0, lt=1)] = 1 / 16  # share of the configurations never trained on
    replay_ratio: Positive = 64.0  # draws per sample that has arrived, while more are to come
    replay_buffer: Annotated[int, Field(ge=0)] = 256  # draws allowed beyond that
    minimum_samples: Count = 8  # training samples to wait for before the first step
    catch_up: Annotated[int, Field(ge=0)] = 2  # further draws a round for a sample that has been drawn less than others

    validate_every: Count = 250  # steps
    validation_samples: Count = 64  # at most so many held-out samples each time
    checkpoint_every: Count = 500  # steps
    poll_seconds: Positive = 1.0  # between looks at the store
    cache_bytes: Annotated[int, Field(ge=0)] = 1 << 30  # of decoded samples kept in memory
    prefetch: Count = 2  # batches read ahead
    threads: Annotated[int, Field(ge=1, le=1024)] = 1  # of torch on the CPU; renderers share the machine
    device: str = "cpu"


def small(**changes: object) -> TrainSettings:
    """Settings for minutes on a CPU core beside renderers: width 16, at most 4096 points, batches of 2.

    An epoch is 256 samples, so that the rate falls within such a run; one configuration of eight is held out.
    """
    described: dict[str, object] = {
        "network": NetworkSettings(width=16, points=4096),
        "batch": 2,
        "epoch_samples": 256,
        "hold_out": 1 / 8,
        "max_steps": 4000,
    }
    return TrainSettings.model_validate({**described, **changes})
