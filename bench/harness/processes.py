"""Processes that are kept ready, and work when they are asked."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Sequence
from typing import Any


class Processes:
    """Processes that each call `serve` with a pipe and some options; they end with this one."""

    def __init__(self, count: int, serve: Callable[..., None], *options: Any) -> None:
        """Start them, and wait until each has come to `answer`."""
        context = multiprocessing.get_context("spawn")  # Dr.Jit does not outlive a fork
        self._pipes, self._processes = [], []
        for _ in range(count):
            here, there = context.Pipe()
            process = context.Process(target=serve, args=(there, *options), daemon=True)
            process.start()
            there.close()
            self._pipes.append(here)
            self._processes.append(process)
        for pipe in self._pipes:
            pipe.recv()

    def ask(self, asked: Sequence[Any]) -> tuple[float, list[Any]]:
        """Give the first processes a thing each, at once; seconds until the last is done, and their answers."""
        start = time.perf_counter()
        pipes = self._pipes[: len(asked)]
        for pipe, one in zip(pipes, asked, strict=True):
            pipe.send(one)
        answers = [pipe.recv() for pipe in pipes]
        return time.perf_counter() - start, answers

    def end(self) -> None:
        """Let them go."""
        for pipe in self._pipes:
            pipe.send(None)
        for process in self._processes:
            process.join()


def answer(pipe: Any, work: Callable[[Any], Any]) -> None:
    """Say that this process is ready; then do what is asked for, and answer with what comes of it."""
    pipe.send("ready")
    while (asked := pipe.recv()) is not None:
        pipe.send(work(asked))
