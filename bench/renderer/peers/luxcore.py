"""LuxCore's BIDIRCPU as a method; it renders in a child process."""

from __future__ import annotations

import importlib.util
import json
import selectors
import subprocess
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from bench.renderer.peers.luxcore_scene import LuxCoreScene
from bench.renderer.peers.methods import Shot

PATIENCE_S = 300.0


def installed() -> bool:
    """Whether pyluxcore can be had; it is not imported here."""
    return importlib.util.find_spec("pyluxcore") is not None


def settings(size: int, max_depth: int, threads: int) -> dict[str, Any]:
    """LuxCore's render configuration without seed and samples.

    Russian roulette begins beyond the longest path, because LuxCore puts it into its densities and is biased by it.
    Its own Sobol' sampler, not adaptive (adaptive sampling is biased). A path is cut where its eye part has more than
    `max_depth` edges or its light part more than `max_depth` − 1: longer paths that fit both stay in, in part.
    """
    return {
        "renderengine.type": "BIDIRCPU",
        "native.threads.count": threads,
        "path.maxdepth": max_depth,
        "light.maxdepth": max(1, max_depth - 1),
        "path.russianroulette.depth": 2 * max_depth + 1,
        "sampler.type": "SOBOL",
        "sampler.sobol.adaptive.strength": 0.0,
        "film.width": size,
        "film.height": size,
        "film.filter.type": "NONE",
        "film.imagepipelines.0.0.type": "NOP",
        "film.outputs.0.type": "RGB",
        "film.outputs.0.filename": "unused.exr",
    }


class LuxCoreMethod:
    """One scene in one child process. Seconds leave out the building of the acceleration structure."""

    def __init__(self, scene: LuxCoreScene, *, size: int, max_depth: int, threads: int) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="luxcore-")
        folder = Path(self._folder.name)
        (folder / "scene.json").write_text(json.dumps(scene.properties))
        (folder / "config.json").write_text(json.dumps(settings(size, max_depth, threads)))
        np.savez(folder / "meshes.npz", **scene.meshes)  # type: ignore[arg-type]
        self._log = (folder / "log").open("w+")
        self._child = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("luxcore_child.py")), str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
        )

    def render(self, seed: int, spp: int) -> Shot:
        """One image. Raises RuntimeError, with the end of its log, if LuxCore fails or answers too late."""
        path = Path(self._folder.name) / "image.npy"
        assert self._child.stdin is not None
        try:
            self._child.stdin.write(json.dumps({"seed": seed, "spp": spp, "image": str(path)}) + "\n")
            self._child.stdin.flush()
        except BrokenPipeError:
            raise self._failure("has ended") from None
        cost = json.loads(self._answer())
        return Shot(np.load(path), cost["wall_s"], cost["cpu_s"])

    def possible(self, spp: float) -> int:
        """The nearest possible samples per pixel."""
        return max(1, round(spp))

    def _answer(self) -> str:
        assert self._child.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._child.stdout, selectors.EVENT_READ)
            if not selector.select(PATIENCE_S):
                raise self._failure(f"has not answered for {PATIENCE_S:.0f} s")
        line = self._child.stdout.readline()
        if not line:
            raise self._failure("has ended")
        return str(line)

    def _failure(self, what: str) -> RuntimeError:
        self._log.seek(0)
        return RuntimeError(f"pyluxcore {what}; the end of its log:\n{self._log.read()[-2000:]}")

    def close(self) -> None:
        """End the child and remove its folder."""
        self._child.kill()
        self._child.wait()
        for stream in (self._child.stdin, self._child.stdout, self._log):
            if stream is not None:
                stream.close()
        self._folder.cleanup()

    def __enter__(self) -> LuxCoreMethod:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()
