"""The page, the picture and the figures of path_data.py."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from bench.harness import results, room_study
from bench.harness.mosaic import Column, mosaic
from bench.harness.network_errors import Errors, each_seed, of_intervals, stated
from bench.studies import path_statistics
from bench.studies.path_data_study import BLOCK, METRICS, Study, Targets
from bench.studies.path_statistics import Bias, BudgetFactor
from photonfarm.trainer.training.losses import RELATIVE_EPSILON

SHOWN = (0.3, 0.6, 0.8, 0.95)  # quantiles of the error of bdpt at budget 1: these views are shown


def in_words(factor: float, budgets: Sequence[float]) -> str:
    """A factor, or beyond which budget it lies."""
    if factor == 0:
        return f"less than {budgets[0]:.2f}"
    return f"{factor:.2f}" if math.isfinite(factor) else f"more than {budgets[-1]:.2f}"


def in_interval(found: BudgetFactor) -> str:
    """A ratio and its 95 % interval."""
    return f"{found.value:.2f} ({found.low:.2f} … {found.high:.2f})"


def within_words(found: BudgetFactor, budgets: Sequence[float]) -> str:
    """The 95 % interval of a factor."""
    return f"{in_words(found.low, budgets)} … {in_words(found.high, budgets)}"


# ------------------------------------------------------------------------------------------------------------- tables


def arms_table(study: Study) -> str:
    header = (
        "data", "× samples", "samples", "core-seconds", "each seen", "MSE (95 %)", "of each seed",
        f"of {BLOCK} × {BLOCK} means", "linear MSE (95 %)",
    )  # fmt: skip
    drawn = study.arguments.steps * study.settings.batch
    lines = [
        [
            f"`{m.arm.kind}`", f"{m.arm.share:g}", m.arm.samples, f"{study.core_s(m.arm):.0f}",
            f"{drawn / m.arm.samples:.1f} times", stated(m.shown), each_seed(m.shown), stated(m.coarse),
            stated(m.linear, 3),
        ]
        for m in study.measured
    ]  # fmt: skip
    return results.table(header, lines)


def pairs_table(study: Study) -> str:
    header = (
        "× samples", "MSE with `path` less that with `bdpt` (95 %)", "of each seed", "share of `path`'s", "of views",
    )  # fmt: skip
    lines = []
    for ours in study.of("bdpt"):
        (theirs,) = (one for one in study.of("path") if one.arm.share == ours.arm.share)
        gap = theirs.shown.less(ours.shown)
        share = gap.estimate().mean / theirs.shown.estimate().mean
        smaller = f"smaller with `bdpt` in {(gap.of_views() > 0).mean():.0%}"
        lines.append([f"{ours.arm.share:g}", stated(gap), each_seed(gap, "+.5f"), f"{share:+.0%}", smaller])
    return results.table(header, lines)


def factors_table(study: Study, targets: Targets) -> str:
    lines = []
    for name, metric in METRICS.items():
        (found, by_seed), (later, _) = study.factor(metric), study.factor(metric, 1)
        seeds = " · ".join(in_words(one, study.budgets) for one in by_seed)
        intervals = [
            f"{within_words(one, study.budgets)}; {study.spread(metric, least):.1%}"
            for one, least in ((found, 0), (later, 1))
        ]
        lines.append([f"error of networks: {name}", in_words(found.value, study.budgets), *intervals, seeds])
    for name, relative in (("noise of targets: variance", False), ("the same, relative to brightness", True)):
        found = study.noise(targets, relative=relative)[2]
        lines.append([name, f"{found.value:.2f}", f"{found.low:.2f} … {found.high:.2f}", "", ""])
    header = (
        "by", "factor of core-seconds", "95 %; spread of seeds, all arms", "95 %; spread of seeds, arms from × 1",
        "of each seed",
    )  # fmt: skip
    return results.table(header, lines)


def costs_table(study: Study, targets: Targets) -> str:
    header = (
        "data", "spp of a half", "core-seconds of both halves", "of a sample with all that goes with it, by the stores",
        "noise of a target", "relative to brightness",
    )  # fmt: skip
    costs = study.costs
    halves_s = (costs.bdpt_s, costs.path_fixed_s + costs.path_spp * costs.path_spp_s)
    noise, relative = (study.noise(targets, relative=relative)[:2] for relative in (False, True))
    lines = [
        [
            f"`{kind}`", made.half_spp, f"{halves_s[i]:.3f}", f"{made.core_s:.3f}", f"{math.sqrt(noise[i]):.3f}",
            f"{math.sqrt(relative[i]):.3f}",
        ]
        for i, (kind, made) in enumerate(study.made.items())
    ]  # fmt: skip
    return results.table(header, lines)


def described(bias: Bias) -> str:
    """A ratio of means with its error."""
    return f"{bias.ratio:.4f} ± {bias.standard_error:.4f} (z = {bias.z:+.1f})"


def verdict(study: Study, targets: Targets) -> str:
    """What came out: errors first, as a factor may hang on little of them."""
    ours = study.of("bdpt")[-1]
    theirs = [(one, budget) for one, budget in zip(study.of("path"), study.budgets, strict=True) if one.arm.share >= 1]
    dearer = ", ".join(f"{budget:.2f}" for _, budget in theirs)
    errors = ", ".join(f"{one.shown.estimate().mean:.5f}" for one, _ in theirs)
    apart = [f"× {one.arm.share:g}" for one, _ in theirs if is_apart(one.shown.less(ours.shown))]
    linear, relative = (study.noise(targets, relative=relative)[2] for relative in (False, True))
    by_all, by_later = (study.factor("shown", least)[0] for least in (0, 1))
    return (
        f"After {ours.arm.samples} samples of `bdpt` the held-out MSE is {ours.shown.estimate().mean:.5f}. After data "
        f"of `path` of {dearer} times the core-seconds it is {errors}; told apart from that of `bdpt`: "
        f"{' and '.join(apart) or 'none'}. By lines through all arms `path` needs "
        f"{in_words(by_later.value, study.budgets)} times the core-seconds for the error of `bdpt`. The 95 % interval "
        f"of that is wide: {within_words(by_later, study.budgets)} with the spread of seeds of the arms from × 1, and "
        f"{within_words(by_all, study.budgets)} with that of all arms. By the variance of noise alone it needs "
        f"{in_interval(relative)} times, relative to brightness, and {in_interval(linear)} times in exposed linear "
        "radiance, where what is brightest leads."
    )


def is_apart(gap: Errors) -> bool:
    """Whether the interval of a difference leaves out 0."""
    low, high = gap.interval()
    return low > 0 or high < 0


# --------------------------------------------------------------------------------------------------------------- page


def page(study: Study, targets: Targets, picture: str) -> str:
    """The tables as Markdown."""
    arguments, spec, references, settings = study.arguments, study.spec, study.references, study.settings
    title, seeds = arguments.experiment, room_study.counted(len(arguments.seeds), "seed")
    all_light, alike = path_statistics.bias(targets.bdpt, targets.path)
    redrawn = " and ".join(f"{made.redrawn} of `{kind}`" for kind, made in study.made.items())
    return f"""# Training data by `bdpt` and by `path`, against core-seconds

{verdict(study, targets)}

The room of the experiment `{title}` at {spec.film.width}², connections {spec.transport.connections}, light
ratio {spec.transport.light_ratio:g}; Mitsuba's `path` has the same `max_depth` {spec.transport.max_depth} and
`rr_depth` {spec.transport.rr_depth}, the box filter and Mitsuba's stratified samples `multijitter`, one render for
each half; those of `bdpt` are stratified too. Its samples per pixel fill a grid and are no power of two, with which
images were seen to be too dark; a sample is meant to cost as much, by times that were taken before. Budgets are given
as multiples of the samples of `bdpt`'s largest (“× samples”); core-seconds are those in the markers of the stores,
medians over jobs, with editing, buffers, guides, photons and visibility, and factors are of them. Both
stores are of one spec: the views, point clouds, photons and held-out configurations of `path`'s are those of `bdpt`'s
bit by bit, and its first {study.of("bdpt")[-1].arm.samples} training samples are of the same views. What `path` has
beyond, at budgets above 1, are further configurations.

For each arm alike {room_study.described(settings)}, the same for both kinds of samples.
{seeds}, of weights and of the order of samples; plan seed {arguments.plan_seed}.
All arms are measured after the last step, on {room_study.counted(len(references.rows), "view")} of
{len(set(references.units))} further configurations.

**MSE** is in the metric space, clip(I, 0, 1)^(1/2.2), against references of {references.spp} spp by `bdpt` whose
noise is taken out by their halves, but for what that curve makes of it; **of {BLOCK} × {BLOCK} means**, the same of
blocks of pixels. **Linear MSE** is in exposed linear radiance, in the same way.
{of_intervals(len(arguments.seeds))} All are for this one draw of configurations and of noise, which
the seeds share: with another draw values may lie outside.

## What a sample costs, and its noise

{costs_table(study, targets)}

Core-seconds of both halves are means over views, of the times taken before; {study.costs.path_fixed_s:.3f} of those
of `path` are its calls', whatever the samples. Launches of `bdpt` are recorded and replayed; those of `path` are not,
as replayed they take longer. Were its calls for nothing, all factors would be {study.without_calls:.3f} times what
they are. By the stores a sample of `path` costs {study.dearer:.2f} times one of `bdpt`; by the times taken before, with
all else as in `bdpt`'s, {study.dearer_before:.2f} times. Why is not known; the farm's processes share caches and
memory. By the latter, all factors would be {study.dearer_before / study.dearer:.2f} times what they are.
**Noise of a target**: standard deviation of (A + B)/2, from the
difference of A and B, root mean square over pixels of the held-out views, exposed linear radiance; **relative**, over
√(I² + {RELATIVE_EPSILON:g}) of the references' brightness I, much as the loss weighs pixels. Renders that were not
finite, and drawn again: {redrawn}.

**Bias.** On the {len(targets.units)} views that both stores have, the mean of the targets of `path` over that of
`bdpt`'s is {described(all_light)}; with each view counted alike {described(alike)}.

## Errors

{arms_table(study)}

At equal numbers of samples, one of `path` at {study.dearer:.3f} times the core-seconds, on the same views:

{pairs_table(study)}

From {seeds} little is known of what seeds change: intervals of arms whose seeds
differ are wide, and may pass 0. Small arms are where training is the least reliable; what follows is decided by those
from × 1. What is left there need not be noise: part of it may not be in what the network is given, as the pattern of a
metal surface is in no buffer ([training.md](../training.md)).

## By what factor the core-seconds of `path` must grow

{factors_table(study, targets)}

**Error of networks**: the budget of `path`, over that of `bdpt` at budget 1, at which its error comes down to that of
`bdpt` first, by lines through its arms over the logarithm of the budget; where these are flat, a difference
within the noise of seeds moves it far. Intervals are a bootstrap's: configurations drawn
with replacement, the same for all arms, and each arm's mean moved by a normal deviate of what seeds move it,
pooled over all arms or over those from × 1: the spread, a share of the mean. **Noise of targets**: the ratio of
variances × that of core-seconds of a sample, over held-out configurations. The two need not agree: more samples of
`path` are more configurations too, and not all of a network's error comes from noise.

## Pictures

From left to right: the reference; a target of `bdpt` and one of `path` at {study.dearer:.2f} times the cost, both
held-out too; what is predicted after `bdpt` at budget 1 and after `path` at each budget from 1, from seed
{arguments.seeds[0]}, with the MSE.
From top to bottom: the views at the quantiles {", ".join(f"{q:g}" for q in SHOWN)} of the error with `bdpt`.

![the reference, targets of both kinds and predictions of {len(SHOWN)} held-out views]({picture})"""


def picture(study: Study, targets: Targets) -> Any:
    """One image (PIL): a line per view."""
    ours = study.of("bdpt")[-1]
    ranked = np.argsort(ours.shown.values[0])
    views = [int(ranked[round(q * (len(ranked) - 1))]) for q in SHOWN]
    held_out = [targets.held_out[view] for view in views]
    columns: list[Column] = [("reference", study.references.mean[views], None)]
    for kind, halves in (("bdpt", targets.bdpt), ("path", targets.path)):
        columns.append((f"target, {kind}", halves[held_out].mean(axis=1), None))
    predicted = (ours, *(one for one in study.of("path") if one.arm.share >= ours.arm.share))
    columns += [
        (f"{m.arm.kind}, {m.arm.samples} samples", m.images[views], m.shown.values[0][views]) for m in predicted
    ]
    return mosaic(columns)


def document(study: Study, targets: Targets) -> dict[str, Any]:
    """The figures of path_data.json; of each view, its errors from each seed. A factor of null is beyond the arms."""
    arms = [
        {**asdict(m.arm), "core_s": study.core_s(m.arm), "train_s": m.train_s}
        | {metric: np.round(getattr(m, metric).values, 6).tolist() for metric in METRICS.values()}
        for m in study.measured
    ]
    noise = {name: study.noise(targets, relative=name == "relative") for name in ("linear", "relative")}
    all_light, alike = path_statistics.bias(targets.bdpt, targets.path)
    return room_study.document(study.settings, study.arguments, study.references) | {
        "experiment": study.arguments.experiment,
        "costs": asdict(study.costs) | {"path_spp": study.costs.path_spp, "sampler": "multijitter"},
        "factors_without_calls": study.without_calls,
        "rendered": {
            kind: {"half_spp": made.half_spp, "core_s": made.core_s, "redrawn": made.redrawn}
            for kind, made in study.made.items()
        },
        "bias": {"all_light": asdict(all_light), "each_view_alike": asdict(alike), "views": len(targets.units)},
        "noise": {name: {"bdpt": a, "path": b, "ratio": asdict(found)} for name, (a, b, found) in noise.items()},
        "factors": {metric: in_json(*study.factor(metric)) for metric in METRICS.values()},
        "factors_by_seeds_from_1": {metric: in_json(*study.factor(metric, 1)) for metric in METRICS.values()},
        "arms": arms,
    }


def in_json(found: BudgetFactor, of_seeds: Sequence[float]) -> dict[str, Any]:
    """A factor as JSON has it, which knows no infinity."""
    finite = {name: value if math.isfinite(value) else None for name, value in asdict(found).items()}
    return {**finite, "of_seeds": [value if math.isfinite(value) else None for value in of_seeds]}
