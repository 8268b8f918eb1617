"""A network and a loss from a user's own file take part in everything that ours take part in."""

import json
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner, Result

from photonfarm.cli.main import umbrella
from photonfarm.core.errors import SpecError
from photonfarm.plan.request import Request
from photonfarm.store import SceneStore, Store
from photonfarm.trainer import train
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import CHECKPOINT, METRICS
from photonfarm.trainer.training.losses import LOSSES, find_loss, judge

MODULE = '''
import torch
from torch import nn


class PerPixel(nn.Module):
    """Two layers on albedo, normal and depth of each pixel."""

    def __init__(self, settings, frame):
        super().__init__()
        self.scale = frame.scale
        self.layers = nn.Sequential(nn.Linear(7, settings.width), nn.ReLU(), nn.Linear(settings.width, 3))

    def forward(self, inputs):
        depth = inputs.depth[..., None] / self.scale
        return inputs.albedo * self.layers(torch.cat([inputs.albedo, inputs.normal, depth], dim=-1))


class Normalised(PerPixel):
    """The same with batch normalisation, whose running means no gradient changes, and with one weight in two places."""

    def __init__(self, settings, frame):
        super().__init__(settings, frame)
        self.norm, self.again = nn.BatchNorm2d(3), self.layers

    def forward(self, inputs):
        return self.norm(super().forward(inputs).permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


def squared(prediction, target):
    return ((prediction[:, None] - target) ** 2).sum() / len(prediction)


def absolute(prediction, target):
    return (prediction[:, None] - target).abs().mean()


number = 7
'''


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a module in the current folder."""
    name = f"mine_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return name


@pytest.fixture
def store(scene: SceneStore, commit) -> Path:
    scene.plan(Request(modifications=12, views_per_modification=1), shard_rows=6)
    for job in range(scene.jobs()):
        commit(scene, job)
    return scene.folder.parent.parent


def photonfarm(*arguments: object) -> Result:
    return CliRunner().invoke(umbrella, [str(argument) for argument in arguments])


def test_a_network_and_a_loss_of_ones_own_are_trained_evaluated_and_reported(
    mine: str, store: Path, tmp_path: Path
) -> None:
    common = ["--store", store, "--set", "hold_out=0.4", "--steps", 4, "--batch", 2, "--set", "validate_every=2"]
    ours = ["train", *common, "--run", "ours", "--architecture", "cnn", "--set", "width=2"]
    own = ["train", *common, "--run", "own", "--architecture", f"{mine}:PerPixel", "--loss", f"{mine}:squared"]
    for command in (ours, own):
        assert (result := photonfarm(*command)).exit_code == 0, result.output
    assert f"{mine}:squared is unbiased" in result.output
    logged = [json.loads(line) for line in (tmp_path / "own" / METRICS).read_text().splitlines()]
    assert [record["loss"] for record in logged if record["kind"] == "loss"] == [f"{mine}:squared"]

    runs = ["--store", store, "--run", "ours", "--run", "own"]
    assert (result := photonfarm("evaluate", *runs)).exit_code == 0, result.output
    assert f"{mine}:PerPixel" in result.output
    assert (result := photonfarm("report", *runs, "--out", "report")).exit_code == 0, result.output
    report = json.loads((tmp_path / "report/report.json").read_text())
    assert f"{mine}:PerPixel" in json.dumps(report)
    spec = photonfarm("train", "--store", store, "--architecture", f"{mine}:PerPixel", "--summary")
    assert "other" in spec.output


def test_running_means_and_shared_weights_are_kept_and_validated_with(mine: str, store: Path, tmp_path: Path) -> None:
    common = ["--store", store, "--set", "hold_out=0.4", "--steps", 4, "--batch", 2, "--set", "average=0.5"]
    own = photonfarm("train", *common, "--run", "own", "--architecture", f"{mine}:Normalised")
    assert own.exit_code == 0, own.output
    weights = checkpoint.load(tmp_path / "own" / CHECKPOINT)["average"]["weights"]
    assert weights["norm.num_batches_tracked"] == 4
    assert weights["norm.running_mean"].abs().max() > 0
    logged = [json.loads(line) for line in (tmp_path / "own" / METRICS).read_text().splitlines()]
    last = [record["error"] for record in logged if record["kind"] == "validation"][-1]
    assert photonfarm("evaluate", "--store", store, "--run", "own").exit_code == 0
    evaluated = json.loads((tmp_path / "own/evaluation.json").read_text())
    assert evaluated["rows"][0]["linear_mse"]["mean"] == pytest.approx(last, rel=1e-5)


def test_every_loss_of_ours_is_found_unbiased_and_a_biased_one_is_refused(mine: str) -> None:
    verdicts = {name: judge(loss) for name, loss in LOSSES.items()}
    assert all(verdict.is_unbiased for verdict in verdicts.values()), verdicts
    assert verdicts["linear"].elsewhere < 5
    assert verdicts["paired"].elsewhere > 10, "its weights are of the noise: its minimum alone is the clean image"
    loss, verdict = find_loss(f"{mine}:squared")
    assert verdict is not None
    assert verdict.is_unbiased
    assert loss(torch.ones(1, 1, 1, 3), torch.zeros(1, 2, 1, 1, 3)) == 6
    with pytest.raises(SpecError, match="bias"):
        find_loss(f"{mine}:absolute")


@pytest.mark.parametrize(
    ("name", "lacks"),
    [("{}:Nothing", "PerPixel"), ("{}:number", "torch.nn.Module"), ("no_such_module:Net", "no_such_module")],
)
def test_what_is_no_network_is_refused(mine: str, store: Path, name: str, lacks: str) -> None:
    with pytest.raises(SpecError, match=lacks):
        CliRunner().invoke(
            umbrella,
            ["train", "--store", str(store), "--architecture", name.format(mine), "--summary"],
            catch_exceptions=False,
        )


@pytest.mark.parametrize("option", ["--architecture", "--loss"])
def test_a_module_that_is_not_there_is_said_before_samples_are_waited_for(tmp_path: Path, option: str) -> None:
    arguments = ("train", "cornell", "--store", tmp_path / "empty", "--run", tmp_path / "run", option, "nowhere:Net")
    with pytest.raises(SpecError, match="finds no module 'nowhere'"):
        CliRunner().invoke(umbrella, [str(argument) for argument in arguments], catch_exceptions=False)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("    def __init__(self): super().__init__()", "made from (settings, frame)"),
        ("    def forward(self, inputs): return self.layers(inputs.albedo)", "line 4, in forward: RuntimeError: mat1"),
        ("    def forward(self, inputs): return super().forward(inputs)[..., :1]", "(2, 16, 16, 1)"),
        ("    def forward(self, inputs): return inputs.photons.power", "`needs` does not name are None"),
    ],
)
def test_an_error_in_a_users_network_is_one_sentence(
    mine: str, store: Path, tmp_path: Path, body: str, said: str
) -> None:
    (tmp_path / f"{mine}_wrong.py").write_text(f"from {mine} import PerPixel\n\nclass Wrong(PerPixel):\n{body}\n")
    settings = {"hold_out": 0.4, "batch": 2, "architecture": f"{mine}_wrong:Wrong", "width": 4}
    with pytest.raises(SpecError) as refused:
        train(store, Store(store).scenes()[0].spec.name, "run", max_steps=1, **settings)
    assert f"architecture = '{mine}_wrong:Wrong'" in str(refused.value)
    assert said in str(refused.value)
