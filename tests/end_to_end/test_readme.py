"""The Python of README.md and of the pages runs as it is written, on a small store and without rendering."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import store_samples as samples
import torch

from photonfarm.shared.plan.request import Request
from photonfarm.shared.store import Store
from photonfarm.trainer.training.unbiasedness import judged

ROOT = Path(__file__).parents[2]


def blocks(page: str) -> list[str]:
    """The Python blocks of a page."""
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store that the pages read: 40 committed samples of a scene named room."""
    place = tmp_path_factory.mktemp("pages") / "store"
    opened = Store(place, create=True)
    scene = opened.scene(opened.plan(samples.small_spec(name="room"), Request(modifications=40)).scene_id)
    scene.write_base(*samples.base())
    samples.commit_all(scene)
    return place


@pytest.fixture(autouse=True)
def folder(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with that store in it."""
    (tmp_path / "store").symlink_to(store)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def ran(code: str) -> dict[str, Any]:
    """What code leaves under which names."""
    left: dict[str, Any] = {}
    exec(code, left)
    return left


def test_the_five_lines_of_the_readme_open_a_scene_and_make_a_loader(capsys: pytest.CaptureFixture[str]) -> None:
    (five_lines,) = blocks("README.md")
    assert len([line for line in five_lines.splitlines() if line]) == 5
    loader = ran(five_lines)["loader"]
    assert capsys.readouterr().out.startswith("40 (2, 8, 8, 3) (8, 8, 3) Modification(")
    assert (loader.batch_size, loader.num_workers) == (8, 2)
    batch = next(iter(torch.utils.data.DataLoader(loader.dataset, batch_size=8)))  # in this process
    assert batch["radiance"].shape == (8, 2, 8, 8, 3)


@pytest.mark.parametrize(("page", "count"), [("docs/tutorial.md", 4), ("docs/python.md", 2)])
def test_the_blocks_of_a_page_run_one_after_the_other(page: str, count: int) -> None:
    found = blocks(page)
    assert len(found) == count
    left = ran("\n".join(found))
    assert len(left["scene"]) == 40
    assert left["half_a"].shape == (8, 8, 3)


def test_the_network_and_the_loss_of_the_training_page_do_what_it_says() -> None:
    (module,) = [block for block in blocks("docs/training.md") if "nn.Module" in block]
    mine = ran(module)
    network = mine["PerPixel"](SimpleNamespace(width=4), SimpleNamespace(scale=2.0))
    image = torch.ones(2, 8, 8, 3)
    guides = SimpleNamespace(direct=image)
    inputs = SimpleNamespace(albedo=image, normal=image, depth=torch.ones(2, 8, 8), guides=guides)
    assert network(inputs).shape == image.shape
    assert network.needs.guides
    assert not network.needs.points
    assert judged(mine["weighted"]).is_unbiased
