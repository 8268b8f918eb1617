#!/usr/bin/env python3
"""What editing a scene in place costs: kernels compiled after the first two modifications, milliseconds per image.

    python bench/edits.py [--spec room] [--modifications 40] [--json OUT]

One thread, as in a worker. Every modification gets one view: edit, buffers, photons, two half-estimates.
Exit code 0 if nothing was compiled after the first two modifications, else 1.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any


def measure(name: str, modifications: int) -> dict[str, Any]:
    """Kernels compiled per modification, and the median milliseconds of each part."""
    from photonfarm.renderer import backend

    backend.load(threads=1)
    import drjit as dr

    from photonfarm.renderer.scenes import LoadedScene
    from photonfarm.shared.modification import sample_modification
    from photonfarm.shared.scene import load_spec
    from photonfarm.shared.view import sample_view

    spec = load_spec(name)
    scene = LoadedScene.load(spec)
    compiled, times = [], defaultdict(list)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for i in range(modifications):
            modification = sample_modification(spec, 0, i)
            view = sample_view(spec, modification.key(spec.scene_id), 0, 0)
            dr.kernel_history_clear()
            parts = {
                "edit": lambda m=modification: scene.apply(m),
                "buffers": lambda v=view: scene.buffers(v),
                "photons": lambda i=i: scene.photons(i),
                "half A": lambda v=view, i=i: scene.render_half(v, 2 * i),
                "half B": lambda v=view, i=i: scene.render_half(v, 2 * i + 1),
            }
            for part, work in parts.items():
                start = time.perf_counter()
                work()
                times[part].append(1e3 * (time.perf_counter() - start))
            compiled.append(sum(not kernel.get("cache_hit", True) for kernel in dr.kernel_history()))
    return {
        "spec": spec.name,
        "film": [spec.film.width, spec.film.height],
        "half_spp": spec.transport.half_spp,
        "modifications": modifications,
        "removed_groups": sum(int((~sample_modification(spec, 0, i).present).sum()) for i in range(modifications)),
        "kernels_compiled_first_two": sum(compiled[:2]),
        "kernels_compiled_after": sum(compiled[2:]),
        "median_ms": {part: round(statistics.median(values[2:]), 1) for part, values in times.items()},
        "median_ms_per_sample": round(sum(statistics.median(values[2:]) for values in times.values()), 1),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spec", default="room")
    parser.add_argument("--modifications", type=int, default=40)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    result = measure(options.spec, options.modifications)
    text = json.dumps(result, indent=2)
    print(text)
    if options.json:
        options.json.write_text(text + "\n")
    return int(result["kernels_compiled_after"] > 0)


if __name__ == "__main__":
    sys.exit(main())
