"""Two processes on a CPU that share each batch, over gloo, against one that has all of it."""

import copy
import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.parallel import DistributedDataParallel

from photonfarm.core.errors import IncompleteError, PhotonfarmError, SpecError, StoreError
from photonfarm.plan.request import Request
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs import devices as processes
from photonfarm.trainer.runs.devices import Ranks, join_ranks
from photonfarm.trainer.runs.run_folder import CHECKPOINT, METRICS
from photonfarm.trainer.runs.settings import NetworkSettings, TrainSettings
from photonfarm.trainer.training.learner import Learner
from photonfarm.trainer.training.loop import Hooks, train
from photonfarm.trainer.training.other_ranks import assist

pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")

SIZE = 2


def in_both(target: Callable[[Ranks], Any], batch: int = 4) -> list[int | None]:
    """How both processes end that run `target`: 0, or a number for a reason."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def one(rank: int) -> None:
        told = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": SIZE, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        os.environ.update({name: str(value) for name, value in told.items()})
        try:
            with join_ranks("cpu", batch) as group:
                assert group is not None
                target(group)
        except PhotonfarmError as error:
            sys.exit(error.exit_code)

    children = [multiprocessing.get_context("fork").Process(target=one, args=(rank,)) for rank in range(SIZE)]
    for child in children:
        child.start()
    for child in children:
        child.join(120)
    return [child.exitcode for child in children]


def together(make: Callable[[], Any], settings: TrainSettings, run: Path, **how: Any) -> list[int | None]:
    """Train in both; `how` is for rank 0."""

    def target(group: Ranks) -> None:
        if group.rank:
            assist(lambda *_: make(), settings, run, group)
            return
        with group.lead():
            train(make(), settings, run, Hooks(ranks=group, **how))

    return in_both(target, settings.batch)


def weights(run: Path) -> torch.Tensor:
    return torch.cat([w.flatten() for w in checkpoint.load(run / CHECKPOINT)["network"].values()])


@pytest.mark.parametrize(("architecture", "batch"), [("light_transport", 3), ("denoise_4", 5)])
def test_two_processes_end_in_the_weights_of_one_with_the_joint_batch(
    make_source, tiny, run, tmp_path, architecture: str, batch: int
) -> None:
    """This holds also where their parts differ in length, and where they begin with the weights of another run.

    The tolerance is 1e-4 of what the weights have moved by.
    """
    settings = tiny(batch=batch, network=NetworkSettings(width=4, architecture=architecture))
    if architecture == "light_transport":
        train(make_source(24), settings.model_copy(update={"seed": 7, "max_steps": 2}), tmp_path / "other")
        settings = settings.model_copy(update={"start_from": str(tmp_path / "other")})
    train(make_source(24), settings, run)
    assert together(lambda: make_source(24), settings, tmp_path / "both") == [0, 0]
    moved = (weights(run) - torch.cat([w.flatten() for w in initial(run)])).abs()
    apart = (weights(run) - weights(tmp_path / "both")).abs()
    assert moved.mean() > 1e-3
    assert apart.mean() < 1e-4 * moved.mean()
    states = [checkpoint.load(folder / CHECKPOINT) for folder in (run, tmp_path / "both")]
    followed = [json.dumps(state["following"], default=torch.Tensor.tolist) for state in states]
    assert followed[0] == followed[1]
    errors = [state["last_error"] for state in states]
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)


def initial(run: Path) -> list[torch.Tensor]:
    return list(checkpoint.load(run / "initial.safetensors")["network"].values())


def test_each_process_reads_its_own_part_and_only_rank_0_what_is_held_out(make_source, tiny, run, tmp_path) -> None:
    def target(group: Ranks) -> None:
        source = make_source(24)
        if group.rank:
            assist(lambda *_: source, tiny(batch=4), run, group)
        else:
            with group.lead():
                train(source, tiny(batch=4), run, Hooks(ranks=group))
        (tmp_path / f"{group.rank}.json").write_text(json.dumps(source.reads))

    assert in_both(target) == [0, 0]
    reads = [json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(SIZE)]
    held_out = set(checkpoint.load(run / CHECKPOINT)["following"]["held_out"].tolist())
    assert len([row for row in reads[0] if row not in held_out]) >= 12 * 2
    assert len(reads[1]) == 12 * 2
    assert not set(reads[1]) & held_out


BY_ROUNDS = {"network": {"architecture": "guided_denoise", "width": 4, "filter": "own"}, "schedule": "cosine"}


@pytest.mark.parametrize("changes", [{}, {**BY_ROUNDS, "rounds": 2.5}], ids=["steps", "rounds"])
def test_a_killed_run_of_two_goes_on_to_the_same_weights_to_the_bit(make_source, tiny, run, tmp_path, changes) -> None:
    """Also where both have to know at which step the rounds over the samples end, and so the rate falls to 0."""
    settings, killed = tiny(batch=4, **changes), tmp_path / "killed"
    assert together(lambda: make_source(24), settings, run) == [0, 0]

    def die(draws: int, _samples: int) -> None:
        if draws == 4 * 10:
            os.kill(os.getpid(), signal.SIGKILL)

    ended = together(lambda: make_source(24), settings, killed, on_draws=die)
    assert ended == [-signal.SIGKILL, IncompleteError.exit_code], "whoever is left ends as well, and says so"
    assert checkpoint.load(killed / CHECKPOINT)["step"] == 8
    assert together(lambda: make_source(24), settings, killed) == [0, 0]
    assert torch.equal(weights(run), weights(killed))


def test_all_processes_go_back_together_and_keep_the_same_average(make_source, tiny, run, tmp_path) -> None:
    """They go back by the loss, of which the part of rank 1 alone is not finite, and by the held-out error.

    In one session, and in another that goes on from its checkpoint, with what lies beside that.
    """
    settings = tiny(batch=4, learning_rate=0.3, average=0.9, schedule="cosine", warm_up=0)

    def make() -> Any:
        honest, source = Learner.step, make_source(24)
        read = source.read

        def spoilt(row: int) -> Any:
            sample = read(row)
            if os.environ["RANK"] == "1" and len(source.reads) == 3:
                sample.radiance[:] = np.nan
            return sample

        def step(learner: Learner, number: int, batch: Any) -> torch.Tensor:
            value = honest(learner, number, batch)
            told = [*learner.predicting.parameters(), *learner.network.parameters()]
            sums = [weight.double().abs().sum().item() for weight in told]
            with (tmp_path / f"{os.environ['RANK']}.jsonl").open("a") as file:
                file.write(json.dumps([number, float(value), learner.rate(number), sums]) + "\n")
            return value

        Learner.step, source.read = step, spoilt  # in a process of its own
        return source

    for steps in (10, 20):
        assert together(make, settings.model_copy(update={"max_steps": steps}), run) == [0, 0]
    followed = [(tmp_path / f"{rank}.jsonl").read_text().splitlines() for rank in range(SIZE)]
    assert followed[0] == followed[1]
    assert len(followed[0]) == 20
    records = [json.loads(line) for line in (run / METRICS).read_text().splitlines()]
    recovered = [(r["cause"], r["step"], r["back_to"]) for r in records if r["kind"] == "recovered"]
    assert [told for told in recovered if told[0] == "loss"] == [("loss", 4, 0), ("loss", 12, 10)]
    assert "held-out error" in [cause for cause, *_ in recovered]


@pytest.mark.parametrize(("fault", "ended"), [("store", [4, 0]), ("step", [4, 7]), ("loss", [8, 8])])
def test_an_error_of_rank_0_ends_the_others_and_that_of_all_ends_each(
    make_source, tiny, run, fault: str, ended: list[int]
) -> None:
    """The others are told to end if rank 0 cannot read, and see it gone within a step; all have a loss that is none."""

    def fail(*_: Any) -> float:
        raise StoreError("rank 0 fails with its gradient in hand")

    def make() -> Any:
        source = make_source(24)
        if fault == "step" and os.environ["RANK"] == "0":
            Ranks.average_gradients = fail  # in a process of its own
        honest = source.read_samples

        def read_samples(rows: Any, out: Any) -> Any:
            samples = honest(rows, out)
            if fault == "store" and os.environ["RANK"] == "0" and len(source.reads) > 20:
                raise StoreError("the disk is gone")
            if fault == "loss" and len(source.reads) > 20:
                samples[0].radiance[:] = np.nan
            return samples

        source.read_samples = read_samples
        return source

    began = time.monotonic()
    assert together(make, tiny(batch=4, max_steps=40, validate_every=100), run) == ended
    assert time.monotonic() - began < 60


@pytest.mark.slow
def test_a_rank_that_hangs_in_a_step_is_waited_for_by_far_less_than_one_that_has_nothing_to_say(
    make_source, tiny, run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No scene for longer than a step may take, and then a reading of rank 1 that takes longer than that."""
    patience_s = 2.5
    monkeypatch.setattr(processes, "STEP_PATIENCE", timedelta(seconds=patience_s))

    def make() -> Any:
        source, began = make_source(24), time.monotonic()
        source.ready = lambda: time.monotonic() - began > patience_s + 0.5
        honest, hangs = source.read_samples, [2 * patience_s]

        def read_samples(rows: Any, out: Any) -> Any:
            if os.environ["RANK"] == "1" and len(source.reads) > 6 and hangs:
                time.sleep(hangs.pop())
            return honest(rows, out)

        source.read_samples = read_samples
        return source

    assert together(make, tiny(batch=4, checkpoint_every=1), run) == [IncompleteError.exit_code] * 2
    assert 0 < checkpoint.load(run / CHECKPOINT)["step"] < 12


def test_the_gradient_is_torchs_own_to_the_bit_for_equal_parts_and_the_right_one_for_others() -> None:
    """DistributedDataParallel takes the mean over processes, which for unequal parts is not that over samples.

    For parts of a power of two, ours times and over the number of samples changes no bit. The truth is in float64.
    """

    def target(group: Ranks) -> None:
        for lengths, same in (((2, 2), True), ((3, 3), False), ((3, 1), False)):
            compare(group, lengths, same=same)

    def compare(group: Ranks, lengths: tuple[int, int], *, same: bool) -> None:
        torch.manual_seed(0)
        x = torch.randn(sum(lengths), 5)
        network = torch.nn.Sequential(torch.nn.Linear(5, 32), torch.nn.ReLU(), torch.nn.Linear(32, 3))
        own, weights = torch.split(x, lengths)[group.rank], list(network.parameters())

        def gradient(made: torch.nn.Module, inputs: torch.Tensor) -> torch.Tensor:
            made.zero_grad()
            loss = made(inputs).square().mean()
            torch.autograd.backward(loss)
            if made is network and len(inputs) < len(x):
                group.average_gradients(weights, loss, len(inputs))
            return torch.cat([weight.grad.double().flatten() for weight in made.parameters()])

        ours, torchs = gradient(network, own), gradient(DistributedDataParallel(network), own)
        truth = gradient(copy.deepcopy(network).double(), x.double())
        assert torch.equal(ours, torchs) is same
        assert (ours - truth).norm() < 1e-6 * truth.norm()
        assert ((torchs - truth).norm() > 1e-2 * truth.norm()) == (lengths[0] != lengths[1])

    assert in_both(target) == [0, 0]


def test_a_run_that_ends_before_there_is_a_scene_ends_for_both(make_source, tiny, run) -> None:
    def make() -> Any:
        source = make_source(24)
        source.ready = lambda: False
        return source

    assert together(make, tiny(batch=4, max_seconds=0.1), run) == [0, 0]


def test_a_batch_smaller_than_the_group_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "4")
    with pytest.raises(SpecError), join_ranks("cpu", 3):
        pass


@pytest.mark.slow
def test_torchrun_trains_a_store_with_two_processes(scene, commit, run) -> None:
    scene.plan(Request(modifications=12), shard_rows=12)
    commit(scene, 0)
    told = [
        "train",
        "--store",
        str(scene.storage.root),
        "--run",
        str(run),
        "--steps",
        "3",
        "--redis",
        "",
        "--architecture",
        "cnn",
    ]
    launched = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--standalone", "-m"]
    command = [*launched, "--", "photonfarm.cli", *told]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("ended at step 3: steps") == 1
    assert checkpoint.load(run / CHECKPOINT)["step"] == 3
    assert [json.loads(line)["kind"] for line in (run / METRICS).read_text().splitlines()].count("end") == 1
