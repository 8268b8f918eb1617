"""Whether it pays to render next where a network errs, instead of uniformly, at equal core-seconds.

    photonfarm submit SPEC --store STORE --modifications 1024 --views 1 --passes 3 --seed 1
    photonfarm submit SPEC --store STORE --modifications 128 --views 1 --passes 16 --seed 2
    python -m experiments.chosen_views STORE --sample-s 0.035 [--seed 0 …] [--arm uniform …]

The views of 2 to 15 passes are the pool, those of 16 are held out; both are uniform. A network of the preset `small`
is trained on 128 views of the pool for 1000 steps. The errors (f − A)(f − B) of 128 fresh ones, with the weights of the
relative loss, make a model over modification vectors and cameras: the mean, nearest neighbours or ridge regression,
whichever predicts each error best from the others. Of the rest of the pool 256 views are chosen by ½ + ½ error / mean
error, and the network is trained on, on all 512, to step 4000.

Arms: `uniform` chooses uniformly, and gets more views for the time of errors and model; `model`; `oracle` has the error
that the other passes of each candidate give, and `root-oracle` its root; `all` gets all candidates, and pays for none.
In the arms that end in ` weighted`, losses are divided by the density. Prints a line of JSON for each arm. Exit code 0.
"""

from __future__ import annotations

import argparse
import copy
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from photonfarm.core.records import F32
from photonfarm.data.torch_dataset import SceneDataset
from photonfarm.scene.poor_views import is_unlit
from photonfarm.store import SceneReader, Store
from photonfarm.store.read.batch import Batch
from photonfarm.trainer.data.batch import ResidentSamples, TrainingBatch
from photonfarm.trainer.data.feed import read_batch
from photonfarm.trainer.networks import find_needs, predict_image
from photonfarm.trainer.networks.inputs import SceneFrame
from photonfarm.trainer.runs.devices import Ranks
from photonfarm.trainer.runs.settings import TrainSettings, make_settings
from photonfarm.trainer.training.good_state import GoodState
from photonfarm.trainer.training.learner import Learner
from photonfarm.trainer.training.losses import RELATIVE_EPSILON

FIRST, FRESH, NEXT = 128, 128, 256  # views
BEFORE, STEPS = 1000, 4000
HELD_OUT_PASSES = 16
ARMS = ("uniform", "oracle", "root-oracle", "model", "all", "model weighted", "oracle weighted")

Errors = NDArray[np.float64]


class Pool:
    """The views of a store, in memory: one pass of each, and the mean halves of the other passes."""

    def __init__(self, store: Path, settings: TrainSettings) -> None:
        (scene,) = Store(store).scenes()
        self._source = source = SceneReader(store, scene.scene_id)
        self._needs, points = find_needs(settings.network), settings.network.points
        self._dataset = SceneDataset(source, self._needs.fields, exposure=source.spec.exposure, points=points)
        passes: dict[int, list[int]] = {}
        for row in source.refresh().tolist():
            passes.setdefault(source.view_row(row), []).append(row)
        self.pool = [rows[0] for rows in passes.values() if 2 <= len(rows) < HELD_OUT_PASSES]
        self.held_out = [rows[0] for rows in passes.values() if len(rows) == HELD_OUT_PASSES]
        self._rows = {rows[0]: rows for rows in passes.values()}
        self._samples = ResidentSamples(torch.device("cpu"), 1e3)
        self.unlit = {row for row in self.pool if self._is_unlit(row)}
        self.frame = SceneFrame.of(source.spec, *source.base(), settings.network)

    def batch(self, rows: Sequence[int]) -> TrainingBatch:
        """The first passes of some views."""
        fresh = self._samples.list_lacking(rows)
        return self._samples.batch(rows, read_batch(self._source, self._dataset, fresh, self._needs))

    def halves(self, row: int) -> F32:
        """The mean halves of a view, (2, H, W, 3): of a held-out one all, of another those of its later passes."""
        rows = self._rows[row] if len(self._rows[row]) == HELD_OUT_PASSES else self._rows[row][1:]
        mean = np.mean([self._source.read_radiance(each).astype(np.float64) for each in rows], axis=0)
        return np.float32(self._source.spec.exposure) * mean.astype(np.float32)

    def describe(self, rows: Sequence[int]) -> Errors:
        """What a model knows of views: modification vectors, eye and direction, (N, 4 G + 6)."""
        inputs = [self._source.inputs(row) for row in rows]
        ends = np.array([np.split(view.vector.astype(np.float64), 2) for _, view, _ in inputs])
        towards = ends[:, 1] - ends[:, 0]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
        vectors = np.array([modification.vector.ravel() for modification, _, _ in inputs], np.float64)
        return np.concatenate([vectors, ends[:, 0], towards], axis=1)

    def _is_unlit(self, row: int) -> bool:
        (sample,) = self._source.read_samples([row], Batch.empty(self._source.spec, 1, guides=True))
        return is_unlit(sample.images, sample.view.origin, sample.seen_photons, lambda: sample.photons)


# -------------------------------------------------------------------------------------------------------------- errors


@torch.no_grad()
def predict(learner: Learner, pool: Pool, rows: Sequence[int]) -> F32:
    """The images of some views, (N, H, W, 3)."""
    network = learner.predicting.eval()
    parts = [predict_image(network, pool.batch(rows[i : i + 2]).inputs) for i in range(0, len(rows), 2)]
    learner.network.train()
    images: F32 = torch.cat(parts).numpy()
    return images


def find_errors(images: F32, halves: F32, brightness: F32 | None = None) -> Errors:
    """The unbiased error of each image, (N,); with `brightness` (N, H, W, 1) weighted as in the relative loss."""
    weight = 1 if brightness is None else 1 / (brightness**2 + RELATIVE_EPSILON)
    product = weight * (images - halves[:, 0]) * (images - halves[:, 1])
    errors: Errors = product.mean(axis=(1, 2, 3), dtype=np.float64)
    return errors


def grey(images: F32) -> F32:
    """The brightness of images, (N, H, W, 1)."""
    mean: F32 = images.mean(axis=-1, keepdims=True)
    return mean


# --------------------------------------------------------------------------------------------------------------- model


def fit(known: Errors, errors: Errors, new: Errors) -> tuple[Errors, str]:
    """The errors of new views (M,) by the model that predicts each known error best from the others, and its name."""
    mean, deviation = known.mean(axis=0), known.std(axis=0)
    varies = deviation > 1e-9
    a, b = ((x[:, varies] - mean[varies]) / deviation[varies] for x in (known, new))
    count = len(errors)
    tried = [(np.mean((errors - (errors.sum() - errors) / (count - 1)) ** 2), "mean", np.full(len(b), errors.mean()))]
    among, across = (((x[:, None] - a[None]) ** 2).sum(axis=-1) for x in (a, b))
    np.fill_diagonal(among, np.inf)
    for k in (4, 8, 16, 32):
        left_out, found = (errors[np.argsort(d, axis=1)[:, :k]].mean(axis=1) for d in (among, across))
        tried.append((np.mean((errors - left_out) ** 2), f"{k} neighbours", found))
    upper = np.triu_indices(6)  # products of the camera's numbers

    def square(x: Errors) -> Errors:
        return np.concatenate([x, x[:, -6:][:, upper[0]] * x[:, -6:][:, upper[1]]], axis=1)

    for name, of in {"linear": lambda x: x, "quadratic": square}.items():
        p, q = (np.concatenate([np.ones((len(x), 1)), of(x)], axis=1) for x in (a, b))
        for penalty in (3.0, 30.0, 300.0):
            inverse = np.linalg.inv(p.T @ p + np.diag([0.0] + [penalty] * (p.shape[1] - 1)))
            smoother = p @ inverse @ p.T
            residual = (errors - smoother @ errors) / (1 - np.diag(smoother))
            tried.append((np.mean(residual**2), f"ridge, {name}, {penalty:g}", q @ inverse @ p.T @ errors))
    _, name, found = min(tried, key=lambda each: each[0])
    return np.maximum(found, 0), name


def choose(errors: Errors, rng: np.random.Generator) -> tuple[NDArray[np.int64], Errors]:
    """`NEXT` places of candidates, none twice, and the density of each candidate over that of uniform draws.

    The largest log(u) / density are chosen (Efraimidis and Spirakis, Weighted random sampling with a reservoir, 2006).
    """
    density = 0.5 + 0.5 * errors / max(errors.mean(), 1e-12)
    return np.argsort(-np.log(rng.random(len(density))) / density)[:NEXT], density


# ------------------------------------------------------------------------------------------------------------ training


@dataclass(frozen=True)
class Begun:
    """A training at step `BEFORE`: the learner's state and the factor on its rate, and the draws of each row."""

    state: dict[str, Any]
    rate_factor: float
    draws: dict[int, int]


def train(
    pool: Pool,
    settings: TrainSettings,
    rows: Sequence[int],
    steps: range,
    begun: Begun | None = None,
    weights: Mapping[int, float] | None = None,
) -> tuple[Learner, dict[int, int]]:
    """Take steps; in each round a row that was drawn less often comes up to twice more, as in `RoundSampler`."""
    learner = Learner(pool.frame, settings, Ranks())
    if begun is not None:
        learner.restore(copy.deepcopy(begun.state))
        learner.rate_factor = begun.rate_factor
    now: list[int] = []
    if weights is not None:
        learner._loss = _weigh(lambda: torch.tensor([weights.get(row, 1.0) for row in now]))
    good, rng = GoodState(learner, settings), np.random.default_rng([settings.seed, steps.start])
    draws, deck = dict(begun.draws if begun else {}), list[int]()
    lit = [row for row in rows if row not in pool.unlit]
    draws.update((row, 0) for row in lit if row not in draws)
    for step in steps:
        if len(deck) < settings.batch:
            most = max(draws[row] for row in lit)
            more = [row for row in lit for _ in range(1 + min(settings.catch_up, most - draws[row]))]
            deck += [more[i] for i in rng.permutation(len(more))]
        now, deck = deck[: settings.batch], deck[settings.batch :]
        for row in now:
            draws[row] += 1
        good.take_step(step, pool.batch(now))
    return learner, draws


def _weigh(weights: Callable[[], Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    def loss(prediction: Tensor, target: Tensor) -> Tensor:
        brightness = prediction.detach().mean(dim=-1, keepdim=True)
        error = (prediction[:, None] - target) ** 2 / (brightness**2 + RELATIVE_EPSILON)[:, None]
        return (error.mean(dim=(1, 2, 3, 4)) * weights()).mean()

    return loss


# ----------------------------------------------------------------------------------------------------------- comparing


def compare(pool: Pool, seed: int, sample_s: float, arms: Sequence[str]) -> None:
    """Train a seed's arms from its common start, and print what each chose and its held-out errors."""
    settings = make_settings("small", {"seed": seed, "max_steps": STEPS})
    rng = np.random.default_rng([7, seed])
    order = [pool.pool[i] for i in rng.permutation(len(pool.pool))]
    start, candidates = order[: FIRST + FRESH], order[FIRST + FRESH :]
    learner, draws = train(pool, settings, start[:FIRST], range(BEFORE))
    begun = Begun(copy.deepcopy(learner.state()), learner.rate_factor, draws)

    began = time.process_time()
    fresh = [row for row in start[FIRST:] if row not in pool.unlit]
    images, noisy = predict(learner, pool, fresh), np.stack([pool.batch([row]).target[0].numpy() for row in fresh])
    predicted, model = fit(pool.describe(fresh), find_errors(images, noisy, grey(images)), pool.describe(candidates))
    by_model = choose(predicted, rng)
    extra = round((time.process_time() - began) / sample_s)
    images, halves = predict(learner, pool, candidates), np.stack([pool.halves(row) for row in candidates])
    true = find_errors(images, halves, grey(images))
    by_oracle = choose(np.maximum(true, 0), rng)
    everything = rng.permutation(len(candidates))
    by_root = choose(np.sqrt(np.maximum(true, 0)), rng)
    ranks = np.array([np.argsort(np.argsort(each)) for each in (predicted, true)], np.float64)
    about = {
        "seed": seed,
        "model": model,
        "extra": extra,
        "rank_correlation": float(np.asarray(np.corrcoef(ranks))[0, 1]),
    }

    halves = np.stack([pool.halves(row) for row in pool.held_out])
    for arm in arms:
        kind, _, weighted = arm.partition(" ")
        places, density = {
            "uniform": (everything[: NEXT + extra], None),
            "all": (everything, None),
            "model": by_model,
            "oracle": by_oracle,
            "root-oracle": by_root,
        }[kind]
        weights = {candidates[i]: 1 / density[i] for i in places} if weighted and density is not None else None
        rows = start + [candidates[i] for i in places]
        learner, _ = train(pool, settings, rows, range(BEFORE, STEPS), begun, weights)
        images = predict(learner, pool, pool.held_out)
        errors = {
            "linear": find_errors(images, halves),
            "relative": find_errors(images, halves, grey(halves.mean(axis=1))),
        }
        figures = {
            name: {"mean": each.mean(), "99 %": np.quantile(each, 0.99), "each": each.tolist()}
            for name, each in errors.items()
        }
        chosen = float(true[places].mean() / true.mean())
        print(json.dumps({**about, "arm": arm, "chosen_error": chosen, **figures}), flush=True)


def main() -> None:
    """Compare the arms of each seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", type=Path)
    parser.add_argument("--sample-s", type=float, required=True, help="core-seconds to render a sample")
    parser.add_argument("--seed", type=int, action="append", required=True)
    parser.add_argument("--arm", choices=ARMS, action="append", required=True)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    pool = Pool(asked.store, make_settings("small", {}))
    for seed in asked.seed:
        compare(pool, seed, asked.sample_s, asked.arm)


if __name__ == "__main__":
    main()
