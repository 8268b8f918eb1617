"""The settings that training refuses, because they bias under noisy targets; light to import.

A network that is trained on noisy targets finds the clean image only if the gradient is, up to factors that do not
depend on the noise, linear in the target: then its mean is the gradient with the mean target [supplement 3.2, Lemma 1].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

PAGE = "docs/results/networks.md"
"""The source of the figures below: a pixel of mean 0.90 with rare bright samples."""


@dataclass(frozen=True, slots=True)
class BiasReason:
    """The reason why a setting is refused."""

    why: str
    ends_at: tuple[float, float, float] | None = None  # of PAGE's pixel, at 4, 16 and 256 samples a target

    def rule(self, instead: str) -> str:
        """The second half of a message: the measurement, and what is allowed instead."""
        measured = ""
        if self.ends_at is not None:
            values = ", ".join(f"{value:.2f}" for value in self.ends_at)
            measured = f"; a pixel of mean 0.90 ends at {values} with targets of 4, 16, 256 samples ({PAGE})"
        return f"is refused because noisy targets bias it: {self.why}{measured}; {instead}"


L1 = BiasReason("its minimum is at the targets' median and not at their mean", (0.28, 0.31, 0.79))
HUBER = BiasReason("its minimum is between the targets' median and their mean", (0.32, 0.39, 0.88))
LOG = BiasReason("the mean of a logarithm is not the logarithm of the mean", (0.43, 0.60, 0.86))
DISPLAY = BiasReason("clipping and gamma come before the mean over targets is taken", (0.30, 0.37, 0.77))
TARGET_WEIGHT = BiasReason("the weight depends on the target's own noise", (0.20, 0.27, 0.59))
UNDETACHED = BiasReason(
    "the gradient passes through the weight, which rewards bright predictions of noisy pixels", (10.73, 3.36, 1.05)
)
STRUCTURE = BiasReason("it compares contrasts and features, which noise adds to and averaging takes away")
CLIPPED_GRADIENT = BiasReason(
    "it shortens most the steps in which a rare bright target would make up for the others", HUBER.ends_at
)
CLAMPED = BiasReason("clamped targets have a smaller mean than the clean image", (0.33, 0.40, 0.79))

LOSSES: Mapping[str, BiasReason] = {
    **dict.fromkeys(("l1", "mae", "absolute"), L1),
    **dict.fromkeys(("huber", "smooth_l1", "charbonnier"), HUBER),
    **dict.fromkeys(("log", "log1p", "log_mse", "msle"), LOG),
    **dict.fromkeys(("gamma", "srgb", "tonemapped", "tone_mapped", "clipped"), DISPLAY),
    **dict.fromkeys(("smape", "mape", "relative_target", "relmse"), TARGET_WEIGHT),
    **dict.fromkeys(("relative_undetached", "relative_prediction"), UNDETACHED),
    **dict.fromkeys(("ssim", "ms_ssim", "dssim", "lpips", "perceptual", "vgg", "flip"), STRUCTURE),
}
"""The values of `loss` that users of other trainers know."""

KEYS: Mapping[str, BiasReason] = {
    **dict.fromkeys(("gradient_clip", "gradient_clipping", "gradient_clip_val", "grad_clip"), CLIPPED_GRADIENT),
    **dict.fromkeys(("clip_gradient", "clip_gradients", "clip_grad_norm", "max_grad_norm"), CLIPPED_GRADIENT),
    **dict.fromkeys(("clamp", "clamp_targets", "clip_targets", "firefly_clamp", "max_radiance"), CLAMPED),
    **dict.fromkeys(("tone_map", "tone_mapping", "tonemap", "gamma"), DISPLAY),
}
"""The keys of other trainers."""


def refuse(settings: Any) -> Any:
    """Return the settings unchanged; ValidationError, which names key, value and reason, if one of them biases."""
    if not isinstance(settings, Mapping):
        return settings
    found = {key: KEYS[key].rule("leave the key out") for key in settings if key in KEYS}
    loss = settings.get("loss")
    if isinstance(loss, str) and loss.lower() in LOSSES:
        found["loss"] = LOSSES[loss.lower()].rule("use 'linear', or 'relative' or 'paired', whose weights are detached")
    if found:
        faults = [
            InitErrorDetails(type=PydanticCustomError("biased", rule), loc=(key,), input=settings[key])
            for key, rule in found.items()
        ]
        raise ValidationError.from_exception_data("TrainSettings", faults)
    return settings
