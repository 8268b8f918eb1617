"""A training step of this checkout and of another one, in turns: its time, its operators, and how near its values are.

    git worktree add ../before COMMIT
    python -m bench.trainer.step_against ../before [--scene room] [--size 64] [--batch 8] [--width 16] [--rounds 15]
        [--only NAME …]

Each checkout has a process of its own, and both read one store of the scene, for which they must have one id. Times are
processor seconds, ratios are within a round. Operators are those that torch dispatches, without what they call
themselves. Exit code 0.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

PACKAGES = ("shared", "services/renderer", "services/trainer")
COUNTED = (2, 8)
"""The batches whose operators are counted: as many where a step acts on whole batches."""


class Child:
    """The trainer of a checkout in a process of its own, which answers one line of JSON with another."""

    def __init__(self, checkout: Path, store: Path, scene_id: str) -> None:
        paths = os.pathsep.join(str(checkout.resolve() / part) for part in PACKAGES)
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve", str(store), scene_id],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": paths},
        )

    def ask(self, *words: Any) -> Any:
        """What a function of `serve` answers."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(words), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def end(self) -> None:
        """Let it go."""
        self._process.communicate()


class Operators(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts the operators that run in the block."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.count = 0

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        self.count += 1
        return function(*args, **(kwargs or {}))


def serve(store: Path, scene_id: str) -> None:
    """Answer the parent from now on; what is called here is in both checkouts."""
    from photonfarm.store import SceneReader
    from photonfarm.trainer.data.feed import Feed
    from photonfarm.trainer.networks import predict_image
    from photonfarm.trainer.networks.inputs import SceneFrame
    from photonfarm.trainer.runs.devices import Ranks
    from photonfarm.trainer.runs.settings import make_preset
    from photonfarm.trainer.training.learner import Learner
    from photonfarm.trainer.training.losses import find_loss

    torch.set_num_threads(1)
    now: dict[str, Any] = {}

    def make(architecture: str, batch: int, width: int) -> None:
        network = {"architecture": architecture, "width": width}
        settings = make_preset("small", network=network, batch=batch, device="cpu")
        with Feed(SceneReader(store, scene_id), settings) as feed:
            feed.ask(sorted(row for row, _ in feed.arrivals()[0])[:batch])
            frame = SceneFrame.of(feed.spec, *feed.base, settings.network)
            now.update(learner=Learner(frame, settings, Ranks()), batch=feed.take(), loss=find_loss(settings.loss)[0])

    def step() -> None:
        now["learner"].step(0, now["batch"])

    def image() -> None:
        with torch.no_grad():
            predict_image(now["learner"].network, now["batch"].inputs)

    def time_ms(what: str) -> float:
        began = time.process_time()
        {"step": step, "image": image}[what]()
        return (time.process_time() - began) * 1e3

    def count() -> int:
        step()
        with Operators() as operators:
            step()
        return operators.count

    def save(file: str) -> None:
        network, batch = now["learner"].network, now["batch"].for_training()
        network.zero_grad()
        made = predict_image(network, batch.inputs)
        torch.autograd.backward(now["loss"](made, batch.target))
        torch.save([made.detach(), *(weight.grad for weight in network.parameters())], file)

    answers: dict[str, Callable[..., Any]] = {"make": make, "time_ms": time_ms, "count": count, "save": save}
    for line in sys.stdin:
        name, *words = json.loads(line)
        print(json.dumps(answers[name](*words)), flush=True)


def compare(children: Sequence[Child], architecture: str, batch: int, width: int, rounds: int) -> list[str]:
    """A row of the table: operators, times, ratios, and the largest differences of image and gradients."""
    operators = []
    for size in COUNTED:
        for child in children:
            child.ask("make", architecture, size, width)
        operators.append([child.ask("count") for child in children])
    for child in children:
        child.ask("make", architecture, batch, width)
    row = [f"`{architecture}`", *(" · ".join(str(few[place]) for few in operators) for place in (0, 1))]
    for what in ("step", "image"):
        turns = []
        for number in range(rounds + 1):
            order = (0, 1) if number % 2 else (1, 0)
            took = {place: children[place].ask("time_ms", what) for place in order}
            turns.append((took[0], took[1]))
        before, after = zip(*turns[1:], strict=True)
        ratio = statistics.median(b / a for a, b in turns[1:])
        row += [f"{statistics.median(before):.1f}", f"{statistics.median(after):.1f}", f"{ratio:.2f}"]
    return [*row, *(f"{found:.0e}" for found in differences(children))]


def differences(children: Sequence[Child]) -> tuple[float, float]:
    """The largest difference of the images, and of the gradients, each over the largest value of its tensor."""
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder) / str(place)) for place in range(2)]
        for child, file in zip(children, files, strict=True):
            child.ask("save", file)
        pairs = zip(*map(torch.load, files), strict=True)
        image, *gradients = [float((a - b).abs().max() / a.abs().max().clamp(min=1e-30)) for a, b in pairs]
    return image, max(gradients)


def main() -> int:
    """Run the benchmark; returns the exit code."""
    if sys.argv[1:2] == ["--serve"]:
        serve(Path(sys.argv[2]), sys.argv[3])
        return 0
    from bench.harness import results
    from bench.harness.scenes import ready_spec, square
    from bench.trainer.train_step import filled, shown
    from photonfarm.trainer.runs.settings import make_preset

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="the other checkout")
    parser.add_argument("--scene", default="room", help="(room)")
    for name, value in (("size", 64), ("batch", 8), ("width", 16), ("rounds", 15)):
        parser.add_argument(f"--{name}", type=int, default=value, help=f"({value})")
    parser.add_argument("--only", nargs="*", default=list(shown()), help="architectures (all)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        spec = square(ready_spec(options.scene), options.size)
        points = make_preset("small").network.points or spec.points
        scene_id = filled(spec.model_copy(update={"points": points}), Path(folder))
        children = [Child(checkout, Path(folder), scene_id) for checkout in (options.before, results.ROOT)]
        sizes = options.batch, options.width, options.rounds
        rows = [compare(children, architecture, *sizes) for architecture in options.only]
        for child in children:
            child.end()
    counted = f"operators at {' · '.join(map(str, COUNTED))}"
    times = [f"{what} {name}" for what in ("step", "image") for name in ("before, ms", "now, ms", "ratio")]
    header = ("architecture", f"{counted}, before", "now", *times)
    print(results.table((*header, "image differs by", "gradients by"), rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
