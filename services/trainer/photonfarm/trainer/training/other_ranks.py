"""The other processes of a group while rank 0 trains: they compute their part of each batch, at its commands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from photonfarm.trainer.data.batch import ResidentSamples
from photonfarm.trainer.data.feed import Feed, SampleSource
from photonfarm.trainer.runs import checkpoint
from photonfarm.trainer.runs.distributed import Ranks
from photonfarm.trainer.runs.run_folder import CHECKPOINT
from photonfarm.trainer.runs.settings import TrainSettings
from photonfarm.trainer.training.compiled import compiling
from photonfarm.trainer.training.learner import Learner
from photonfarm.trainer.training.recovery import GoodState


def assist(source: Callable[[str, float], SampleSource], settings: TrainSettings, run: Path, ranks: Ranks) -> None:
    """Train with rank 0 until that ends; `source` makes the samples of a scene, given its id and its exposure.

    A resumed run is read from the folder `run`, which rank 0 writes. Raises what `train` does.
    """
    torch.set_num_threads(settings.threads)
    command, value = ranks.receive()
    if command == "end":
        return
    own = settings.model_copy(update={"batch": -(-settings.batch // ranks.size)})
    resident = ResidentSamples(ranks.device(settings.device), settings.resident_gb)
    with Feed(source(value["scene_id"], value["exposure"]), own, resident=resident) as feed:
        good, step = GoodState(Learner(feed, settings, ranks)), value["step"]
        if value["continues"]:
            good.restore(checkpoint.load(run / CHECKPOINT), run, recover=settings.recover)
        with compiling(settings.compile):
            _follow(ranks, feed, good, step)


def _follow(ranks: Ranks, feed: Feed, good: GoodState, step: int) -> None:
    """Follow the commands of rank 0, until it sends the end."""
    while (received := ranks.receive())[0] != "end":
        command, value = received
        if command == "rows":
            feed.ask(ranks.part(value))
        elif command == "keep":
            good.keep(value)
        elif command == "back":
            good.go_back(value)
        elif command == "quiet":
            with feed.quiet():
                ranks.meet()
                if ranks.receive()[0] == "end":  # or "on"
                    return
        else:  # "take"
            good.step_or_go_back(step, feed.take())
            step += 1
