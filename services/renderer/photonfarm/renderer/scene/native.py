"""Embree's build quality, which the Python module of Mitsuba does not offer, set in its library through ctypes.

Mitsuba has Embree build for scenes that never change: one hierarchy over all triangles, with spatial splits, 1 µs a
triangle, at every edit. Embree's low quality, meant for dynamic scenes, makes one hierarchy per mesh and a small one
above them: rebuilds are 4 to 6 times faster, whole edits of the room `room` take 14 instead of 29 ms, and images take
0.9 to 1.02 times as long. Rays meet the same surfaces, except where two surfaces touch; and as light paths learn from
such rays where to start, whole images differ by their noise. So the quality cannot be configured: every worker sets it,
as radiance must follow from keys alone.

Embree's scene is found in the graph of a ray that is not yet traced, which names two addresses: Embree's entry point
and the scene. Nothing is done unless the first is an address that libembree3 exports, so that the second must be the
scene.
"""

from __future__ import annotations

import ctypes
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

_LOW = 0  # RTC_BUILD_QUALITY_LOW
_SET_QUALITY = "_ZN7mitsuba23rtcSetSceneBuildQualityEPNS_10RTCSceneTyENS_15RTCBuildQualityE"
_OCCLUDED = (
    "_ZN7mitsuba12rtcOccluded{n}EPKiPNS_10RTCSceneTyEPNS_19RTCIntersectContextEPNS_7RTCRay{n}E",  # 4 and 8 rays
    "_ZN7mitsuba13rtcOccluded{n}EPKiPNS_10RTCSceneTyEPNS_19RTCIntersectContextEPNS_8RTCRay{n}E",  # 16 rays
)

_POINTER = re.compile(r'^\s*(\d+) \[label="\{Literal: (0x[0-9a-f]+)\|\{Type: LLVM ptr\b', re.MULTILINE)
_TRACE = re.compile(r'^\s*(\d+) \[label="\{trace_ray\|', re.MULTILINE)
_EDGE = re.compile(r"^\s*(\d+) -> (\d+)\b", re.MULTILINE)


def expect_changes(scene: Any) -> bool:
    """Have Embree build the scene for changes from its next rebuild on.

    Returns whether it will: False if Embree does not trace (CUDA, another build of Mitsuba), where edits keep their
    cost.
    """
    library = _open_embree()
    if library is None:
        return False
    entry, accel = _find_embree_scene(scene)
    if entry not in _entry_points(library):
        return False
    dr.sync_thread()
    getattr(library, _SET_QUALITY)(ctypes.c_void_p(accel), ctypes.c_int(_LOW))
    return True


def _open_embree() -> Any:
    """The library libembree3 that Mitsuba has loaded; None if it is not loaded, or lacks the function needed."""
    path = next(Path(mi.__file__).parent.glob("libembree3.so"), None) if mi.variant().startswith("llvm") else None
    library = path and ctypes.CDLL(str(path))
    return library if hasattr(library, _SET_QUALITY) else None


def _entry_points(library: Any) -> set[int]:
    """The addresses of Embree's functions that test 4, 8 or 16 shadow rays."""
    names = {pattern.format(n=n) for pattern in _OCCLUDED for n in (4, 8, 16)}
    functions = [getattr(library, name) for name in names if hasattr(library, name)]
    return {int(ctypes.cast(function, ctypes.c_void_p).value or 0) for function in functions}


def _find_embree_scene(scene: Any) -> tuple[int, int]:
    """The addresses of the function that traces a shadow ray here, and of Embree's scene; zeros if not found."""
    pending = scene.ray_test(mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1)))
    graph = dr.graphviz(as_string=True)
    pointers = {int(node): int(address, 16) for node, address in _POINTER.findall(graph)}
    inputs = _inputs_of_trace(graph, pending.index)
    addresses = [pointers[node] for node in inputs if node in pointers]
    return (addresses[0], addresses[1]) if len(addresses) == 2 else (0, 0)


def _inputs_of_trace(graph: str, result: int) -> list[int]:
    """The inputs of the one traced ray that `result` depends on, in order; empty unless there is exactly one."""
    inputs = defaultdict(list)
    for source, target in _EDGE.findall(graph):
        inputs[int(target)].append(int(source))
    ancestors = {result}
    while fresh := {source for node in ancestors for source in inputs[node]} - ancestors:
        ancestors |= fresh
    traces = ancestors & {int(node) for node in _TRACE.findall(graph)}
    return inputs[traces.pop()] if len(traces) == 1 else []
