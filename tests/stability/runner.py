"""Renders a hard scene and judges it.

A scene passes with the given settings if no value is NaN or infinite; no block's mean differs from the truth's, nor
the whole image's, by more than chance allows (`SIGNIFICANCE`); the standard error of the mean ratio is at most the
effort's resolution (else the test could not fail); and the brightest pixel keeps its bound, where the row has one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from photonfarm.core.statistics import BlockTest, block_means, block_z_test, student_to_normal, two_sided_limit
from tests.stability.scenes.case import BdptSettings, Effort, HardScene, Images, Refusal, load, render

SIGNIFICANCE = 4e-6
"""The probability that a right scene fails with one pair of settings: 0.1 % for 250 pairs, more than there are."""
ROUNDING = 1e-4
"""The least standard error, as a part of the mean: ray offsets and float32 sums are not more exact.

In the shining sphere `path` itself is 0.04 % too bright at depth 2, 0.07 % at depth 3 (row 1), 0.09 % at 24 (row 36).
"""


@dataclass(frozen=True, slots=True)
class SceneResult:
    """A scene's result with one pair of settings; a refusal has no figures."""

    row: int | None
    label: str  # as `--only` takes it
    hard: str
    truth: str
    settings: str  # connections, light paths per eye path
    cpu_s: float
    faults: tuple[str, ...]  # why it failed; empty: it passed
    command: str  # the command that renders it again
    z_max: float | None = None  # largest block |z|, and that of the whole image
    z_limit: float | None = None
    mean_ratio: float | None = None  # bdpt over truth, whole images
    mean_ratio_standard_error: float | None = None
    resolution: float | None = None  # the largest standard error allowed
    max_over_mean: float | None = None  # brightest pixel of any render over the mean
    truth_max_over_mean: float | None = None
    not_finite: int = 0  # values

    @property
    def verdict(self) -> str:
        """`pass` or `FAIL`."""
        return "FAIL" if self.faults else "pass"


@dataclass(frozen=True, slots=True, eq=False)
class Renders:
    """The renders from which a result was judged."""

    bdpt: Images
    truth: Images
    z: npt.NDArray[np.float64]  # [B, B]


@dataclass(frozen=True, slots=True, eq=False)
class SceneOutcome:
    """A result and its renders; a refusal has none."""

    result: SceneResult
    renders: Renders | None = None


def run(
    item: HardScene | Refusal, *, quick: bool, seed: int = 0, settings: Sequence[BdptSettings] = ()
) -> Iterator[SceneOutcome]:
    """One outcome for each pair of settings: those given among the scene's, else the quick ones if quick, else all.

    Yields nothing for a scene without a quick version, or that is not tried with any of these settings.
    """
    if isinstance(item, Refusal):
        yield SceneOutcome(_try_refusal(item, quick))
        return
    effort = item.quick if quick else item.long
    usual = item.quick_settings if quick else item.settings
    tried = [s for s in item.settings if s in settings] if settings else usual
    if effort is None or not tried:
        return
    start = time.process_time()
    truth = item.truth.images(item, effort, seed)
    scene = load(item.build(effort.size))
    if item.edit is not None:
        item.edit(scene)
    for counts in tried:
        integrator = {"type": "bdpt", "max_depth": item.max_depth, "rr_depth": item.rr_depth, **counts.parameters}
        bdpt = render(scene, integrator, effort.spp, range(seed, seed + effort.seeds))
        command = f"python -m tests.stability --only {item.label} --settings {counts} --seed {seed}"
        yield _judge(item, effort, counts, bdpt, truth, start, command + " --quick" * quick)
        start = time.process_time()


def _judge(
    item: HardScene, effort: Effort, settings: BdptSettings, bdpt: Images, truth: Images, start: float, command: str
) -> SceneOutcome:
    with np.errstate(all="ignore"):  # values that are not finite, and black images, are judged below
        blocks, whole = compare(bdpt, truth, effort.blocks), compare(bdpt, truth, 1)
        brightest, truth_brightest = (float(np.max(images) / np.mean(images)) for images in (bdpt, truth))
    figures = {
        "z_max": float(np.fmax(blocks.z_max, whole.z_max)),
        "z_limit": blocks.z_limit,
        "mean_ratio": blocks.mean_ratio,
        "mean_ratio_standard_error": blocks.mean_ratio_standard_error,
        "resolution": effort.resolution,
        "max_over_mean": brightest,
        "truth_max_over_mean": truth_brightest,
    }
    result = SceneResult(
        row=item.row,
        label=item.label,
        hard=item.what_is_hard,
        truth=item.truth.name,
        settings=str(settings),
        cpu_s=time.process_time() - start,
        faults=tuple(_find_faults(item, effort, bdpt, blocks, whole, brightest)),
        command=command,
        not_finite=int((~np.isfinite(bdpt)).sum()),
        **{name: value if math.isfinite(value) else None for name, value in figures.items()},
    )
    return SceneOutcome(result, Renders(bdpt, truth, blocks.z))


def _find_faults(
    item: HardScene, effort: Effort, bdpt: Images, blocks: BlockTest, whole: BlockTest, brightest: float
) -> Iterator[str]:
    bad = int((~np.isfinite(bdpt)).sum())
    if bad:
        yield f"{bad} values are not finite"
        return
    for what, test in (("a block", blocks), ("the mean", whole)):
        if not test.passed:
            yield f"{what}'s |z| is {test.z_max:.2f}, the limit {test.z_limit:.2f}"
    error = blocks.mean_ratio_standard_error
    if not error <= effort.resolution:
        yield f"too noisy to tell: the mean ratio's standard error is {error:.2g}, allowed is {effort.resolution:g}"
    if item.max_over_mean is not None and brightest > item.max_over_mean:
        yield f"the brightest pixel is {brightest:.1f} times the mean, allowed is {item.max_over_mean:g}"


def compare(images: Images, truth: Images, blocks: int) -> BlockTest:
    """The block z-test against other renders [L ≥ 2, …], or Student's t-test against an image known exactly [1, …]."""
    if len(truth) > 1:
        return block_z_test(images, truth, blocks=blocks, significance=SIGNIFICANCE, floor=ROUNDING)
    means, expected = block_means(images, blocks), block_means(truth, blocks)[0]
    error = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    t = (means.mean(axis=0) - expected) / np.maximum(error, ROUNDING * np.maximum(np.abs(expected), truth.mean()))
    z = student_to_normal(t, np.full_like(t, len(means) - 1.0))
    each = np.asarray(images, dtype=np.float64).reshape(len(images), -1).mean(axis=1) / truth.mean()
    limit = two_sided_limit(1 - (1 - SIGNIFICANCE) ** (1 / z.size))
    ratio_error = float(each.std(ddof=1) / np.sqrt(len(each)))
    return BlockTest(z, float(np.abs(z).max()), limit, float(each.mean()), ratio_error, bool(np.isfinite(images).all()))


def plus_minus(value: float, standard_error: float) -> str:
    """A value near 1, two digits of its error, and as many of the value, at most float32's: "1.000260 ± 0.000026"."""
    if not 0 < standard_error < np.inf:
        return f"{value:.7f} ± {standard_error:g}"
    digits = min(max(1 - math.floor(math.log10(standard_error)), 0), 7)
    return f"{value:.{digits}f} ± " + (f"{standard_error:.{digits}f}" if digits < 7 else f"{standard_error:.1e}")


# ------------------------------------------------ Refusals ------------------------------------------------


def message_of(refusal: Refusal, settings: BdptSettings | None = None) -> str:
    """The message with which `bdpt` refuses the scene, with other settings if given; empty if it renders it."""
    try:
        scene = load(refusal.build(8))
        mi.load_dict({"type": "bdpt", **(settings or refusal.settings).parameters}).render(scene, seed=0, spp=1)
    except ValueError as error:
        return str(error)
    return ""


def _try_refusal(refusal: Refusal, quick: bool) -> SceneResult:
    start, text = time.process_time(), message_of(refusal)
    faults = [] if refusal.sentence in text else [f"not refused with {refusal.sentence!r}, but with {text!r}"]
    if refusal.allowed is not None and (again := message_of(refusal, refusal.allowed)):
        faults.append(f"refused with connections,light_ratio = {refusal.allowed} too: {again}")
    return SceneResult(
        row=refusal.row,
        label=refusal.label,
        hard=text,
        truth="refusal",
        settings=str(refusal.settings),
        cpu_s=time.process_time() - start,
        faults=tuple(faults),
        command=f"python -m tests.stability --only {refusal.label}" + " --quick" * quick,
    )
