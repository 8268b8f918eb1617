"""Renders a hard scene and judges it.

A scene passes with the given settings if no value is NaN or infinite; no block's mean differs from the truth's, nor
the whole image's, by more than chance allows (`SIGNIFICANCE`); the standard error of the mean ratio is at most the
effort's resolution (else the test could not fail); and the brightest pixel keeps its bound, where the row has one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from photonfarm.core.statistics import BlockTest, block_means, block_z_test, student_to_normal, two_sided_limit
from tests.stability.scenes.case import BdptSettings, Effort, HardScene, Images, Refusal
from tests.stability.scenes.truths import PATH, load, render

SIGNIFICANCE = 4e-6
"""The probability that a right scene fails with one pair of settings: 0.1 % for 250 pairs, more than there are."""
ROUNDING = 1e-4
"""The least standard error, as a part of the mean: ray offsets and float32 sums are not more exact.

In the shining sphere `path` itself is 0.04 % too bright at depth 2, 0.07 % at depth 3 (row 1), 0.09 % at 24 (row 36).
"""


@dataclass(frozen=True, slots=True)
class SceneResult:
    """A scene's result with one pair of settings: a line of the table."""

    row: int | None
    name: str
    hard: str
    truth: str
    settings: str  # connections, light paths per eye path
    size: int
    seeds: int
    spp: int
    truth_spp: int | None  # None for a truth that is known exactly
    z_max: float | None  # largest block |z|, and that of the whole image
    z_limit: float | None
    mean_ratio: float | None  # bdpt over truth, whole images
    mean_ratio_standard_error: float | None
    resolution: float | None  # the largest standard error allowed
    seen_bias: float | None  # the part of the mean by which the image must be off to fail, if the noise does not help
    seen_block_bias: float | None  # likewise for its worst block, as part of the block's mean
    max_over_mean: float | None  # brightest pixel of any render over the mean
    truth_max_over_mean: float | None
    nan: int
    inf: int
    cpu_s: float
    faults: tuple[str, ...]  # why it failed; empty: it passed
    command: str  # the command that renders it again
    path_ratio: float | None = None  # `path` over a truth that is known exactly: the effect of rounding alone
    path_ratio_standard_error: float | None = None

    @property
    def label(self) -> str:
        """Number and name, as `--only` takes them."""
        return f"{self.row:02d}-{self.name}" if self.row else self.name

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
        yield _refused(item, quick)
        return
    effort = item.quick if quick else item.long
    if effort is None:
        return
    usual = item.quick_settings if quick else item.settings
    tried = [s for s in item.settings if s in settings] if settings else usual
    if not tried:
        return
    start = time.process_time()
    truth = item.truth.images(item, effort, seed)
    path = _path_ratio(item, effort, seed, truth)
    scene = load(item.build(effort.size))
    if item.edit is not None:
        item.edit(scene)
    for counts in tried:
        integrator = {"type": "bdpt", "max_depth": item.max_depth, "rr_depth": item.rr_depth}
        integrator |= counts.parameters
        bdpt = render(scene, integrator, effort.spp, range(seed, seed + effort.seeds))
        command = f"python -m tests.stability --only {item.label} --settings {counts} --seed {seed}"
        outcome = _judged(item, effort, counts, bdpt, truth, start, command + " --quick" * quick)
        yield replace(outcome, result=replace(outcome.result, path_ratio=path[0], path_ratio_standard_error=path[1]))
        start = time.process_time()


def _path_ratio(item: HardScene, effort: Effort, seed: int, truth: Images) -> tuple[float | None, float | None]:
    """The mean ratio of `path` to the truth, and its standard error; None if the truth is a render."""
    if len(truth) > 1:
        return None, None
    found = compare(PATH.images(item, effort, seed), truth, 1)
    return _finite(found.mean_ratio), _finite(found.mean_ratio_standard_error)


def _judged(
    item: HardScene, effort: Effort, settings: BdptSettings, bdpt: Images, truth: Images, start: float, command: str
) -> SceneOutcome:
    with np.errstate(all="ignore"):  # values that are not finite, and black images, are judged below
        blocks, whole = compare(bdpt, truth, effort.blocks), compare(bdpt, truth, 1)
        brightest, truth_brightest = _max_over_mean(bdpt), _max_over_mean(truth)
    z_max = float(np.fmax(blocks.z_max, whole.z_max))
    faults = tuple(_faults(item, effort, bdpt, blocks, whole, brightest))
    result = SceneResult(
        item.row,
        item.name,
        item.hard,
        item.truth.name,
        str(settings),
        effort.size,
        effort.seeds,
        effort.spp,
        effort.truth_spp if len(truth) > 1 else None,
        _finite(z_max),
        blocks.z_limit,
        _finite(blocks.mean_ratio),
        _finite(blocks.mean_ratio_standard_error),
        effort.resolution,
        _finite(seen_bias(bdpt, truth, 1)),
        _finite(seen_bias(bdpt, truth, effort.blocks)),
        _finite(brightest),
        _finite(truth_brightest),
        int(np.isnan(bdpt).sum()),
        int(np.isinf(bdpt).sum()),
        time.process_time() - start,
        faults,
        command,
    )
    return SceneOutcome(result, Renders(bdpt, truth, blocks.z))


def _faults(
    item: HardScene, effort: Effort, bdpt: Images, blocks: BlockTest, whole: BlockTest, brightest: float
) -> Iterator[str]:
    bad = int((~np.isfinite(bdpt)).sum())
    if bad:
        yield f"{bad} values are not finite"
        return
    if not blocks.passed:
        yield f"a block's |z| is {blocks.z_max:.2f}, the limit {blocks.z_limit:.2f}"
    if not whole.passed:
        yield f"the mean's |z| is {whole.z_max:.2f}, the limit {whole.z_limit:.2f}"
    if not blocks.mean_ratio_standard_error <= effort.resolution:
        yield (
            f"too noisy to tell: the mean ratio's standard error is {blocks.mean_ratio_standard_error:.2g}, allowed is "
            f"{effort.resolution:g}"
        )
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


def seen_bias(images: Images, truth: Images, blocks: int) -> float:
    """The smallest bias that fails, as part of a block's mean: that of the worst block, without black ones."""
    with np.errstate(all="ignore"):
        means, expected = block_means(images, blocks), block_means(truth, blocks)
        variance = means.var(axis=0, ddof=1) / len(means)
        if len(truth) > 1:
            variance = variance + expected.var(axis=0, ddof=1) / len(truth)
        level = expected.mean(axis=0)
        error = np.maximum(np.sqrt(variance), ROUNDING * level)
        limit = two_sided_limit(1 - (1 - SIGNIFICANCE) ** (1 / level.size))
        return float(np.max(limit * (error / level)[level > 0], initial=0.0))


def plus_minus(value: float, standard_error: float) -> str:
    """A value near 1, two digits of its error, and as many of the value, at most float32's: "1.000260 ± 0.000026"."""
    if not 0 < standard_error < np.inf:
        return f"{value:.7f} ± {standard_error:g}"
    digits = min(max(1 - math.floor(math.log10(standard_error)), 0), 7)
    return f"{value:.{digits}f} ± " + (f"{standard_error:.{digits}f}" if digits < 7 else f"{standard_error:.1e}")


def _max_over_mean(images: Images) -> float:
    return float(np.max(images) / np.mean(images))


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


# ------------------------------------------------ Refusals ------------------------------------------------


def message_of(refusal: Refusal, size: int = 8) -> str:
    """The message with which `bdpt` refuses the scene; empty if it renders it."""
    return _refusal(load(refusal.build(size)), refusal.settings)


def _refusal(scene: object, settings: BdptSettings) -> str:
    try:
        mi.load_dict({"type": "bdpt", **settings.parameters}).render(scene, seed=0, spp=1)
    except ValueError as error:
        return str(error)
    return ""


def _refused(refusal: Refusal, quick: bool) -> SceneOutcome:
    start = time.process_time()
    text = message_of(refusal)
    faults = [] if refusal.sentence in text else [f"not refused with {refusal.sentence!r}, but with {text!r}"]
    if refusal.allowed is not None and (again := _refusal(load(refusal.build(8)), refusal.allowed)):
        faults.append(f"refused with connections,light_ratio = {refusal.allowed} too: {again}")
    result = SceneResult(
        refusal.row,
        refusal.name,
        text,
        "refusal",
        str(refusal.settings),
        8,
        1,
        1,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        0,
        0,
        time.process_time() - start,
        tuple(faults),
        f"python -m tests.stability --only {refusal.label}" + " --quick" * quick,
    )
    return SceneOutcome(result)
