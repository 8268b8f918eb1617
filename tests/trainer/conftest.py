"""The analytic room as tests of training want it, and tiny settings."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from analytic_room import analytic_base, analytic_spec
from analytic_room_samples import AnalyticSource, ScarceSource, commit_job

from photonfarm.core.records import BasePointCloud, Geometry
from photonfarm.scene.spec import SceneSpec
from photonfarm.store import SceneStore, Store
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    """Torch on one processor thread: small tensors gain nothing from more, and sums stay in one order."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def make_source() -> Callable[..., AnalyticSource]:
    """A source of so many analytic samples; how: views=, noise=, per_look=."""

    def make(
        samples: int,
        *,
        size: int = 16,
        points: int = 256,
        moving: bool = True,
        photons: int = 0,
        exposure: float = 1.0,
        **how: Any,
    ) -> AnalyticSource:
        spec = analytic_spec(size, points, moving=moving, photons=photons, exposure=exposure)
        return AnalyticSource(spec, samples, **how)

    return make


@pytest.fixture
def make_scarce() -> Callable[..., ScarceSource]:
    """A source of so many analytic samples of which more come only once training has waited: lot=, patience=."""

    def make(samples: int, **how: Any) -> ScarceSource:
        return ScarceSource(analytic_spec(16, 256), samples, **how)

    return make


@pytest.fixture(scope="session")
def tiny() -> Callable[..., TrainSettings]:
    """Settings of a tiny network on tiny batches, with changes."""

    def settings(**changes: Any) -> TrainSettings:
        described = {"network": NetworkSettings(width=4), "batch": 3, "hold_out": 0.25, "poll_seconds": 0.01}
        described |= {"max_steps": 12, "validate_every": 5, "checkpoint_every": 4, "validation_samples": 8}
        return TrainSettings.model_validate({**described, **changes})

    return settings


@pytest.fixture
def scene(tmp_path: Path, request: pytest.FixtureRequest) -> SceneStore:
    """A store's scene with its base written and nothing else; of the exposure that a test asks for, or 1."""
    spec = analytic_spec(16, 256, exposure=getattr(request, "param", 1.0))
    scene = Store(tmp_path / "store", create=True).add(spec)
    scene.write_base(*analytic_base(scene.spec))
    return scene


@dataclass(frozen=True)
class Analytic:
    spec: SceneSpec
    base: tuple[Geometry, BasePointCloud]


@pytest.fixture
def analytic() -> Analytic:
    """The scene of `scene`, and what its base is, where there is no store yet."""
    spec = analytic_spec(16, 256)
    return Analytic(spec, analytic_base(spec))


@pytest.fixture
def commit() -> Callable[[SceneStore, int], bool]:
    """What writes one job of a scene."""
    return commit_job


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a training run."""
    return tmp_path / "run"
