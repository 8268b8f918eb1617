"""A checkout compared with itself has the same operators and the same values."""

from pathlib import Path

import pytest

from bench.trainer import train_step
from bench.trainer.step_against import Child, compare
from bench.trainer.train_step import filled, resized

ROOT = Path(__file__).parents[3]


@pytest.mark.slow
def test_a_checkout_differs_in_nothing_from_itself(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(train_step, "SAMPLES", 32)
    scene_id = filled(resized(16, 64), tmp_path)
    children = [Child(ROOT, tmp_path, scene_id) for _ in range(2)]
    name, before, now, *times, image, gradients = compare(children, "guided_transport", 2, 4, 1)
    for child in children:
        child.end()
    assert name == "`guided_transport`"
    few, many = before.split(" · ")
    assert before == now
    assert few == many
    assert all(float(figure) > 0 for figure in times)
    assert float(image) == float(gradients) == 0
