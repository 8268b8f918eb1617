"""A checkpoint that a trainer replaces is read whole, before or after."""

import threading
import time
from pathlib import Path

import torch

from photonfarm.trainer.runs import checkpoint


def test_a_checkpoint_is_read_while_it_is_replaced(tmp_path: Path) -> None:
    file, stop = tmp_path / "checkpoint.safetensors", threading.Event()

    def replace() -> None:
        step = 0
        while not stop.is_set():
            step += 1  # files of many sizes, so that a mix of two cannot be read
            checkpoint.save(file, {"step": step, "weights": torch.full((1 + step % 7, 1000), float(step))})
            time.sleep(0.001)

    checkpoint.save(file, {"step": 0, "weights": torch.zeros(1, 1000)})
    writer = threading.Thread(target=replace)
    writer.start()
    try:
        for _ in range(500):
            state = checkpoint.load(file)
            assert bool((state["weights"] == state["step"]).all())
    finally:
        stop.set()
        writer.join()
