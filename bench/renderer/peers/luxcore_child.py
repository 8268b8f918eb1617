"""LuxCore's bidirectional path tracer in a process of its own: python luxcore_child.py FOLDER.

FOLDER holds scene.json, config.json and meshes.npz. Each line of standard input asks for an image, as JSON {"seed",
"spp", "image"}; the image is written to that .npy, and its cost as a JSON line to standard output. Knows neither
Mitsuba nor photonfarm.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np  # before pyluxcore, which crashes otherwise

POLL_S = 0.002


def properties(luxcore: Any, values: dict[str, Any]) -> Any:
    """LuxCore's Properties of a dictionary."""
    result = luxcore.Properties()
    for key, value in values.items():
        result.Set(luxcore.Property(key, value))
    return result


def build(luxcore: Any, folder: Path) -> Any:
    """The scene that FOLDER describes."""
    scene = luxcore.Scene()
    meshes = np.load(folder / "meshes.npz")
    for name in sorted({key.rpartition(".")[0] for key in meshes.files}):
        points, faces = (
            [tuple(row) for row in meshes[f"{name}.{part}"].tolist()] for part in ("vertices", "faces")
        )  # tuples: nothing else is taken
        key = f"{name}.normals"
        normals = [tuple(row) for row in meshes[key].tolist()] if key in meshes.files else None
        scene.DefineMesh(name, points, faces, normals, None, None, None)
    scene.Parse(properties(luxcore, json.loads((folder / "scene.json").read_text())))
    return scene


def render(luxcore: Any, scene: Any, config: dict[str, Any], seed: int, spp: int) -> tuple[Any, dict[str, float]]:
    """([H, W, 3] image, top row first, and its cost)."""
    settings = properties(luxcore, {**config, "renderengine.seed": seed, "batch.haltspp": spp})
    session = luxcore.RenderSession(luxcore.RenderConfig(settings, scene))
    start, cpu = time.perf_counter(), time.process_time()
    session.Start()
    started = time.perf_counter()
    while not session.HasDone():  # WaitForDone never returns in 2.11.2
        time.sleep(POLL_S)
        session.UpdateStats()
    session.Stop()
    image = np.zeros((config["film.height"], config["film.width"], 3), np.float32)
    session.GetFilm().GetOutputFloat(luxcore.FilmOutputType.RGB, image, 0)
    cost = {"prepare_s": started - start, "wall_s": time.perf_counter() - started, "cpu_s": time.process_time() - cpu}
    return np.ascontiguousarray(image[::-1]), cost


def main() -> None:
    """Answer until standard input ends."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # pyluxcore writes to standard output from C++
    folder = Path(sys.argv[1])
    luxcore = importlib.import_module("pyluxcore")

    luxcore.Init(lambda _: None)
    scene = build(luxcore, folder)
    config = json.loads((folder / "config.json").read_text())
    for line in sys.stdin:
        request = json.loads(line)
        image, cost = render(luxcore, scene, config, request["seed"], request["spp"])
        np.save(request["image"], image)
        print(json.dumps(cost), file=answers, flush=True)
    os._exit(0)  # its threads crash an ordinary exit


if __name__ == "__main__":
    main()
