"""The weights of real paths against an oracle that knows none of the integrator's formulas."""

from __future__ import annotations

import pytest

from tests.stability.scenes.case import BdptSettings
from tests.stability.weights import weight_check
from tests.stability.weights.oracle import F64
from tests.stability.weights.weight_check import SCENES, compare_weights

LANES = 256


@pytest.mark.parametrize(
    "settings", [BdptSettings(1, 1.0), BdptSettings(4, 0.25), BdptSettings(1, 1.0, guided_light=True)], ids=str
)
@pytest.mark.parametrize("name", SCENES)
def test_weights_of_real_paths_sum_to_one_and_are_the_oracles(name: str, settings: BdptSettings) -> None:
    found = compare_weights(SCENES[name], settings, lanes=LANES)
    assert found.faults == (), f"{name}, {settings}: {found}"
    assert found.paths >= 40


def test_paths_without_connections_or_light_paths_have_the_oracles_weights_too() -> None:
    for settings in (BdptSettings(0, 1.0), BdptSettings(0, 0.0)):
        found = compare_weights(SCENES["shiny-room"], settings, lanes=LANES)
        assert found.faults == (), f"{settings}: {found}"
        assert found.with_delta >= 50


def test_a_wrong_count_of_connections_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = weight_check.oracle.technique_counts
    monkeypatch.setattr(weight_check.oracle, "technique_counts", lambda k, n, ratio: counts(k, 1.1 * n, ratio))
    assert "a weight is off" in compare_weights(SCENES["cornell"], BdptSettings(1, 1.0), lanes=LANES).faults[0]


def test_joining_light_paths_to_the_lens_at_their_first_vertex_would_be_found(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = weight_check.oracle.technique_counts

    def with_splats_of_direct_light(k: int, n: float, ratio: float) -> F64:
        found = counts(k, n, ratio)
        found[k] = ratio
        return found

    monkeypatch.setattr(weight_check.oracle, "technique_counts", with_splats_of_direct_light)
    assert compare_weights(SCENES["cornell"], BdptSettings(1, 1.0), lanes=LANES).faults
