"""Networks that torch compiles: the same values, and one sentence where they cannot be compiled."""

from pathlib import Path
from typing import Any

import pytest
import torch

from photonfarm.core.errors import SpecError
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.run_folder import CHECKPOINT
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.loop import train

pytestmark = pytest.mark.filterwarnings("ignore")  # torch's compiler has deprecations of its own

HAS_CUDA = torch.cuda.is_available()


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A folder of its own for the kernels, compiled by this process; nothing is left of them afterwards."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "kernels"))
    monkeypatch.setenv("TORCHINDUCTOR_COMPILE_THREADS", "1")
    yield
    torch.compiler.reset()


def test_by_default_nothing_is_compiled(make_source, tiny, run, monkeypatch: pytest.MonkeyPatch) -> None:
    assert TrainSettings().compile == "off"
    monkeypatch.setattr(torch.nn.Module, "compile", lambda *_, **__: pytest.fail("compiled"))
    train(make_source(24), tiny(max_steps=1), run)


def test_cuda_graphs_on_a_cpu_are_refused(make_source, tiny, run) -> None:
    with pytest.raises(SpecError, match="CUDA graphs need a CUDA device"):
        train(make_source(24), tiny(compile="graphs", device="cpu"), run)


def test_without_a_compiler_a_run_ends_with_what_to_do(make_source, tiny, run, kernels) -> None:
    from torch._inductor import config

    with (
        config.patch({"cpp.cxx": (None, "/no/compiler")}),
        pytest.raises(SpecError, match=r"compile = 'on'.*C\+\+ compiler.*compile = off"),
    ):
        train(make_source(24), tiny(compile="on", device="cpu"), run)


@pytest.mark.slow
def test_a_compiled_run_is_the_other_but_for_rounding(make_source, tiny, run, tmp_path, kernels) -> None:
    settings = tiny(validate_every=100, average=0.5, device="cpu", max_steps=6)
    train(make_source(24), settings, run)
    train(make_source(24), settings.model_copy(update={"compile": "on", "max_steps": 3}), tmp_path / "compiled")
    compiled = torch._dynamo.utils.counters["stats"]["unique_graphs"]
    train(make_source(24), settings.model_copy(update={"compile": "on"}), tmp_path / "compiled")  # goes on
    one, other = (checkpoint.load(folder / CHECKPOINT) for folder in (run, tmp_path / "compiled"))
    assert compiled >= 1
    assert other["step"] == 6
    assert one["network"].keys() == other["network"].keys()
    begin = checkpoint.load(run / "initial.safetensors")["network"]
    for name, weight in one["network"].items():
        moved = (weight - begin[name]).abs().mean()
        assert (weight - other["network"][name]).abs().mean() <= 0.02 * moved, name


@pytest.mark.skipif(not HAS_CUDA, reason="there is no CUDA device, and only such record graphs")
@pytest.mark.parametrize("how", ["on", "graphs"])
def test_on_cuda_a_compiled_run_has_the_error_of_the_other(make_source, tiny, run, tmp_path, kernels, how: str) -> None:
    settings = tiny(device="cuda", validate_every=100)
    train(make_source(24), settings, run)
    train(make_source(24), settings.model_copy(update={"compile": how}), tmp_path / "compiled")
    errors = [checkpoint.load(folder / CHECKPOINT)["last_error"] for folder in (run, tmp_path / "compiled")]
    assert errors[0] == pytest.approx(errors[1], rel=1e-2)
