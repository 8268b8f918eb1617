"""The settings of training, with each default and its reason, and those that it refuses; light to import (no torch).

Where a default is the supplement's, its section is named; the others are ours. A setting is refused if it biases under
noisy targets: a network finds the clean image only if the gradient is, up to factors that do not depend on the noise,
linear in the target: then its mean is the gradient with the mean target [supplement 3.2, Lemma 1].
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BeforeValidator, Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from photonfarm.core.errors import SpecError
from photonfarm.core.models import Count, Frozen, Positive, sentences
from photonfarm.plan.hold_out import HOLD_OUT
from photonfarm.scene.poor_views import PoorKind
from photonfarm.trainer.runs.user_code import is_own

PAGE = "docs/results/networks.md"
"""The source of the figures below: a pixel of mean 0.90 with rare bright samples."""


def _explain(why: str, *ends_at: float) -> str:
    """The reason why a setting is refused, and where PAGE's pixel ends with it, at 4, 16 and 256 samples a target."""
    values = ", ".join(f"{value:.2f}" for value in ends_at)
    measured = f"; a pixel of mean 0.90 ends at {values} with targets of 4, 16, 256 samples ({PAGE})" if ends_at else ""
    return f"is refused because noisy targets bias it: {why}{measured}; "


L1 = _explain("its minimum is at the targets' median and not at their mean", 0.28, 0.31, 0.79)
HUBER = _explain("its minimum is between the targets' median and their mean", 0.32, 0.39, 0.88)
LOG = _explain("the mean of a logarithm is not the logarithm of the mean", 0.43, 0.60, 0.86)
DISPLAY = _explain("clipping and gamma come before the mean over targets is taken", 0.30, 0.37, 0.77)
TARGET_WEIGHT = _explain("the weight depends on the target's own noise", 0.20, 0.27, 0.59)
UNDETACHED = _explain(
    "the gradient passes through the weight, which rewards bright predictions of noisy pixels", 10.73, 3.36, 1.05
)
STRUCTURE = _explain("it compares contrasts and features, which noise adds to and averaging takes away")
CLIPPED_GRADIENT = _explain(
    "it shortens most the steps in which a rare bright target would make up for the others", 0.32, 0.39, 0.88
)
CLAMPED = _explain("clamped targets have a smaller mean than the clean image", 0.33, 0.40, 0.79)

BIASING_LOSSES: Mapping[str, str] = {
    **dict.fromkeys(("l1", "mae", "absolute"), L1),
    **dict.fromkeys(("huber", "smooth_l1", "charbonnier"), HUBER),
    **dict.fromkeys(("log", "log1p", "log_mse", "msle"), LOG),
    **dict.fromkeys(("gamma", "srgb", "tonemapped", "tone_mapped", "clipped"), DISPLAY),
    **dict.fromkeys(("smape", "mape", "relative_target", "relmse"), TARGET_WEIGHT),
    **dict.fromkeys(("relative_undetached", "relative_prediction"), UNDETACHED),
    **dict.fromkeys(("ssim", "ms_ssim", "dssim", "lpips", "perceptual", "vgg", "flip"), STRUCTURE),
}
"""The values of `loss` that users of other trainers know."""

BIASING_KEYS: Mapping[str, str] = {
    **dict.fromkeys(("gradient_clip", "gradient_clipping", "gradient_clip_val", "grad_clip"), CLIPPED_GRADIENT),
    **dict.fromkeys(("clip_gradient", "clip_gradients", "clip_grad_norm", "max_grad_norm"), CLIPPED_GRADIENT),
    **dict.fromkeys(("clamp", "clamp_targets", "clip_targets", "firefly_clamp", "max_radiance"), CLAMPED),
    **dict.fromkeys(("tone_map", "tone_mapping", "tonemap", "gamma"), DISPLAY),
}
"""The keys of other trainers."""


def refuse_biasing(settings: Any) -> Any:
    """Return the settings unchanged; ValidationError, which names key, value and reason, if one of them biases."""
    if not isinstance(settings, Mapping):
        return settings
    rules = {key: f"{BIASING_KEYS[key]}leave the key out" for key in settings if key in BIASING_KEYS}
    if reason := BIASING_LOSSES.get(str(settings.get("loss")).lower()):
        rules["loss"] = f"{reason}use 'linear', or 'relative' or 'paired', whose weights are detached"
    faults = [
        InitErrorDetails(type=PydanticCustomError("biased", rule), loc=(key,), input=settings[key])
        for key, rule in rules.items()
    ]
    if faults:
        raise ValidationError.from_exception_data("TrainSettings", faults)
    return settings


Occlusion = Literal["exact", "window"]
PaperNetwork = Literal["cnn", "feature_projection", "light_transport", "light_transport_photons"]
GuidedNetwork = Literal[  # ours
    "guided", "guided_transport", "guided_photons", "guided_transport_photons", "guided_denoise"
]
Architecture = Literal[PaperNetwork, GuidedNetwork, "denoise_1", "denoise_4", "denoise_16", "denoise_32", "denoise_64"]
Precision = Literal["float32", "tf32", "bfloat16"]
Maxima = Literal["absolute", "relative"]
EmissionScale = Literal["linear", "log"]
Loss = Literal["linear", "relative", "paired"]
Optimiser = Literal["adam", "rmsprop"]
Compilation = Literal["off", "on", "graphs"]
Schedule = Literal["epochs", "cosine"]
LayerRates = Literal["equal", "scaled"]
ReadyDenoiser = Literal[
    "none",
    "fill-in",
    "oidn",
    "oidn-balanced",
    "oidn-fast",
    "oidn-reflectance",
    "oidn-balanced-reflectance",
    "oidn-fast-reflectance",
]
"""Kept pixels as they are; the rest filled in; then denoised by Open Image Denoise: in its best quality, a quicker one,
or its quickest; by diffuse albedo, or by the reflectance of all lobes and of what mirrors show, 1 on lamps."""

OidnQuality = Literal["high", "balanced", "fast"]  # as the package names them

HalfFilterName = Literal["auto", "own", "oidn", "oidn-balanced", "oidn-fast"]
"""Open Image Denoise by the names above; a filter of our own; or, until a run begins, whichever is there."""


def _check_choice(kind: Any) -> BeforeValidator:
    """A validator for the values of a literal, and for `MODULE:NAME`."""

    def check(name: object) -> object:
        if name not in get_args(kind) and not (isinstance(name, str) and is_own(name)):
            *first, last = map(repr, get_args(kind))
            rule = f"must be {', '.join(first)} or {last}, or MODULE:NAME of your own"
            raise PydanticCustomError("own_or_literal", "{rule}", {"rule": rule})
        return name

    return BeforeValidator(check)


ArchitectureName = Annotated[str, _check_choice(Architecture)]
LossName = Annotated[str, _check_choice(Loss)]

MOST_HELD_OUT = 512
"""The most samples that a finished run is measured on."""


class NetworkSettings(Frozen):
    """The settings of the network; other values make another network, and old checkpoints are refused."""

    architecture: ArchitectureName = "light_transport"  # or MODULE:NAME, a class of your own
    width: Annotated[int, Field(ge=1, le=512)] = 64  # d of the image synthesis layer [S Fig. 2]
    points: Count | None = None  # first points of the base cloud to use; None: all of them
    descriptor: Annotated[int, Field(ge=0, le=512)] = 32  # learnable numbers per point
    octaves: Annotated[int, Field(ge=0, le=16)] = 2  # of sines and cosines of each position, beside the position
    maxima: Maxima = "absolute"  # over the points [S Fig. 1]; "relative": less those of the base configuration (ours),
    # with which it takes fewer steps to learn what lights do
    emission: EmissionScale = "linear"  # of the points, over its root mean square; "log" (ours): its logarithm, so that
    # bright windows do not hide lamps from the maxima
    occlusion: Occlusion = "exact"  # which points are hidden: as rendered, or by the supplement's rule on the depth
    # buffer, "window"; of what it keeps, 23 to 68 % is hidden (docs/results/networks.md)
    occlusion_tolerance: Positive = 1e-3  # of that rule [S 1.2]
    precision: Precision = "float32"  # of the image synthesis layer; its weights and its image are float32 in any case;
    # "tf32" is of NVIDIA's cards alone (docs/results/train_step.md)
    lit_points: Count = 512  # of guided_transport: points that send light on, at most as many as are lit
    filter: HalfFilterName = "auto"  # of the half that guided_denoise is given: a filter of our "own", and beside it
    # Open Image Denoise unless it is "own"; "auto": its best quality where it is installed, else "own", as is settled
    # when a run begins
    reflectance: bool = False  # of denoise_K (ours): it is given the reflectance of all lobes, and of what mirrors
    # show, for diffuse albedo, so that patterns of metals and mirrored ones are not smoothed away
    least_specular: Annotated[float, Field(ge=0, le=0.2)] = 0.0  # of guided networks (ours): what a surface that has
    # any lobe but the diffuse one reflects by it, at least, where it is smooth; 0.04 is glass seen straight on, of
    # which the guides' few samples find nothing
    filter_direct: bool = False  # of guided networks (ours): direct light, whose samples are few, is
    # also filtered by its noise and the surfaces, and each pixel has a learned share of it as it is and as filtered
    demodulation: Annotated[float, Field(gt=0, le=1)] | None = None  # ε: output × (albedo + ε) is the image; None: not;
    # guided networks have a rule of their own, and ignore it

    @property
    def has_denoiser(self) -> bool:
        """Whether `filter` names Open Image Denoise, of a run that has begun."""
        return self.filter not in ("auto", "own")

    @model_validator(mode="after")
    def _fits_its_architecture(self) -> Self:
        if self.architecture == "feature_projection" and not self.descriptor:
            raise ValueError("has descriptor = 0; feature_projection projects descriptors, and at least 1 is needed")
        return self


EARLIER: Mapping[str, Any] = {"least_specular": 0.0, "filter_direct": False}
"""The settings that a run of before there were any lacks, each with the value by which its network is what it was."""


class TrainSettings(Frozen):
    """The settings of a training run."""

    network: NetworkSettings = NetworkSettings()
    seed: Annotated[int, Field(ge=0, lt=1 << 32)] = 0

    loss: LossName = "linear"  # [S 3.2]; "relative" and "paired" are ours, for lamps in view; all have the
    # clean image as their minimum, and the first two the gradients of clean targets too [S Lemma 1]; or
    # MODULE:NAME, a function of your own, which is refused if it is found to bias
    batch: Count = 32  # [S 3.1: 32 dynamic, 128 static]
    learning_rate: Positive = 5e-4  # [S 3.1]
    layer_rates: LayerRates = "equal"  # "scaled" (ours): a layer of more than 144 inputs has 144 / inputs of the
    # rate, as Adam changes what it puts out by the rate times its inputs; so one rate is good for all widths
    decay: Annotated[float, Field(gt=0, le=1)] = 0.99  # of the rate, per epoch [S 3.1]
    epoch_samples: Count = 50_000  # an epoch counts samples drawn, so the schedule ignores how much has arrived
    optimiser: Optimiser = "adam"  # [S 3.1]
    beta1: Annotated[float, Field(ge=0, lt=1)] = 0.9
    beta2: Annotated[float, Field(ge=0, lt=1)] = 0.999  # with rare fireflies 0.9999 … 0.99999: 1 / (1 − β₂) steps
    # must see some 25 of them, or the weights that they reach stay too dark (docs/results/networks.md)
    alpha: Annotated[float, Field(ge=0, lt=1)] = 0.99  # of RMSprop, as β₂ of Adam: with 0.99 it darkens even more
    schedule: Schedule = "epochs"  # of the rate: × decay an epoch [S 3.1]; "cosine" (ours): up, then down to 0 at
    # max_steps, so that a run's last steps shake its weights the least; without decay and epochs
    warm_up: Annotated[float, Field(ge=0, lt=1)] = 0.03  # share of max_steps in which "cosine" rises: Adam's means are
    # of few steps then, and its first steps would else be its worst
    average: Annotated[float, Field(ge=0, lt=1)] = 0.0  # of the weights, kept after each step, with which a run
    # predicts: 0.999 remembers 1000 steps, over which their noise is evened out; 0: none
    recover: bool = True  # where it gets much worse than it was, or is not finite, a run goes back to good weights,
    # with half the rate, so that a night of training ends little worse than it once was

    start_from: str | None = None  # the folder of a run whose weights it begins with; it is read before the first step
    max_steps: Count = 150_000  # [S 4]
    max_seconds: Positive | None = None  # wall time of all sessions of the run together

    hold_out: Annotated[float, Field(gt=0, lt=1)] = 1 / 16  # share of the configurations never trained on
    skip_views: tuple[PoorKind, ...] = ()  # kinds of views that are never trained on, by their inputs alone (ours)
    replay_ratio: Positive = 64.0  # draws per sample that has arrived, while more are to come
    replay_buffer: Annotated[int, Field(ge=0)] = 256  # draws allowed beyond that
    rounds: Positive = 12.0  # draws of each sample, at most, by guided_denoise: it could learn by heart what a half
    # goes with, and 13 rounds were fine where 45 tripled the error
    minimum_samples: Count = 8  # training samples to wait for before the first step
    catch_up: Annotated[int, Field(ge=0)] = 2  # further draws a round for a sample that has been drawn less than others

    validate_every: Count = 250  # steps
    validation_samples: Count = 64  # at most so many held-out views each time, by the first sample of each
    checkpoint_every: Count = 500  # steps
    poll_seconds: Positive = 1.0  # between looks at the store
    prefetch: Count = 2  # batches read ahead
    threads: Annotated[int, Field(ge=1, le=1024)] = 1  # of torch on the CPU; renderers share the machine
    device: str = "auto"  # cuda where torch has one, and otherwise the cpu
    compile: Compilation = "off"  # "on": torch.compile makes kernels for the U-Net, which takes minutes at first, and
    # is slower than without on a CPU (docs/results/train_step.md); "graphs": with CUDA graphs too
    deterministic: bool = False  # on a card, that a run that was killed ends in the weights of one that was not, to the
    # bit, as on a processor anyway; it costs time, as no sum is taken in the order in which its terms are ready
    resident_gb: Literal["auto"] | Annotated[float, Field(ge=0)] = "auto"  # of decoded samples that are kept on the
    # device; "auto": on CUDA while a quarter of the card is free, and none on a CPU, beside whose memory the files lie

    @model_validator(mode="before")
    @classmethod
    def _refuse_what_biases(cls, settings: Any) -> Any:
        return refuse_biasing(settings)

    @model_validator(mode="after")
    def _has_the_other_half(self) -> Self:
        if self.loss == "paired" and "denoise" in self.network.architecture:
            raise ValueError(
                f"has loss = 'paired', which weights each half by the other; {self.network.architecture} is given one "
                "of them, and 'linear' or 'relative' are its losses"
            )
        return self


KEYS = tuple(key for key in (*TrainSettings.model_fields, *NetworkSettings.model_fields) if key != "network")
"""Every key that can be set, including those of the network."""


PAPER = {"network": {"points": 16384}}

SMALL: Mapping[str, Any] = {
    "network": {
        "architecture": "guided_transport",
        "width": 16,
        "points": 4096,
        "maxima": "relative",  # so short a run learns little of lights from absolute ones
        "emission": "log",
        "reflectance": True,  # 39 % less error of denoise_1 in fixed-veach-ajar (docs/results/tables.md)
        "least_specular": 0.04,  # a black screen had 11 % of the error in one room (docs/results/networks.md)
    },
    "loss": "relative",
    "batch": 2,
    "learning_rate": 3e-3,
    "layer_rates": "scaled",
    "schedule": "cosine",  # rises and falls over the whole run, however short
    "average": 0.99,
    "epoch_samples": 256,
    "hold_out": HOLD_OUT,
    "skip_views": ("unlit",),  # one of 448 had a third of the squared gradient
    "max_steps": 4000,
}

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "small": SMALL,
    "card": {
        **SMALL,
        "network": {**SMALL["network"], "width": 64, "precision": "bfloat16"},
        "batch": 8,
        "epoch_samples": 1024,
        "max_steps": 10_000,
    },
    "paper": {
        "network": {**PAPER["network"], "octaves": 0, "occlusion": "window", "maxima": "absolute"},
        "recover": False,
    },
    "paper-static": {**PAPER, "batch": 128},
    "paper-dynamic": PAPER,
}
"""The presets, by what differs from the defaults above.

`paper-static` and `paper-dynamic` have the supplement's settings for static scenes, and for movable objects and lights
[S 3.1], with 16 384 points (ours). Images are 256² there, and 128² in the static ablation [S Fig. 2]; here they have
the size of the scene's film. `paper` is the supplement to the letter, as far as it goes: positions have no octaves,
projection uses the rule on the depth buffer [S 1.2], maxima are absolute [S Fig. 1], and a run never goes back.
docs/training-settings.md lists the remaining choices of ours, with reasons. `small` is all ours, for minutes on a CPU
core beside renderers; `card` is the same for minutes of a card, as wide as the supplement's networks.
"""


def find_preset(name: str, architecture: object = None) -> Mapping[str, Any]:
    """A preset for an architecture, by what differs from the defaults.

    Of `small` and `card`, guided_denoise has a third of the rate: at that of others a run of it jumped in its first
    steps, and at 0.001 it learns as fast (docs/results/networks.md).
    """
    preset = PRESETS[name]
    if architecture == "guided_denoise" and "learning_rate" in preset:
        return {**preset, "learning_rate": 1e-3}
    return preset


def make_preset(name: str, *, network: Mapping[str, object] = MappingProxyType({}), **changes: object) -> TrainSettings:
    """The settings of a preset with changes, those of its network in `network`. Raises ValidationError."""
    preset = find_preset(name, network.get("architecture"))
    return TrainSettings.model_validate({**preset, **changes, "network": {**preset["network"], **network}})


def make_settings(base: str | TrainSettings, changes: Mapping[str, Any]) -> TrainSettings:
    """A preset, or the settings of a run, with changes by key; keys of the network stand among the others.

    Raises SpecError for each fault.
    """
    network = {key: value for key, value in changes.items() if key in NetworkSettings.model_fields}
    others = {key: value for key, value in changes.items() if key not in network}
    if "network" in others:
        raise SpecError("the settings of the training: network: its keys are set each by its own name, as in width=32")
    if isinstance(base, str) and base not in PRESETS:
        raise SpecError(f"the settings of the training: preset = {base!r}: is none of {', '.join(PRESETS)}")
    try:
        if isinstance(base, str):
            return make_preset(base, network=network, **others)
        kept = base.model_dump()
        return TrainSettings.model_validate({**kept, **others, "network": {**kept["network"], **network}})
    except ValidationError as error:
        said = "; ".join(sentence.removeprefix("network.") for sentence in sentences(error, KEYS))
        raise SpecError(f"the settings of the training: {said}") from error
