"""Embree set up for a scene that will change, so that it is rebuilt 4 to 6 times faster.

Mitsuba has Embree build for scenes that never change: one hierarchy over all triangles, with spatial splits, 1 µs a
triangle. That was nearly all of the cost of an edit, as every edit builds it anew. Embree's low quality, meant for
dynamic scenes, makes one hierarchy per mesh and a small one above them. In the furnished rooms rays then take 0.7 to
1.1 times as long (medians by scene and kind of ray), images 0.9 to 1.02 times. Its medium quality traces about as fast
and takes a third longer to build. Rays meet the same surfaces, except where two surfaces touch.

Mitsuba has no parameter for it, so it is set directly, through Embree's own C interface. The only way to its scene is
the graph of a ray that is not yet traced, which names two addresses: Embree's entry point and the scene. Nothing is
done unless the first is an address that libembree3 exports, so that the second must be the scene.
"""

from __future__ import annotations

import ctypes
import re
from collections import defaultdict
from typing import Any

import drjit as dr
import mitsuba as mi

from photonfarm.renderer.scene.native.libraries import library_of

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
    library = _embree()
    if library is None:
        return False
    entry, accel = _traced_by(scene)
    if entry not in _entry_points(library):
        return False
    dr.sync_thread()
    getattr(library, _SET_QUALITY)(ctypes.c_void_p(accel), ctypes.c_int(_LOW))
    return True


def _embree() -> Any:
    """The library libembree3 that Mitsuba has loaded, with the functions needed; None if it is not loaded."""
    return library_of(mi, "libembree3.so", (_SET_QUALITY,)) if mi.variant().startswith("llvm") else None


def _entry_points(library: Any) -> set[int]:
    """The addresses of Embree's functions that test 4, 8 or 16 shadow rays."""
    names = {pattern.format(n=n) for pattern in _OCCLUDED for n in (4, 8, 16)}
    found = [getattr(library, name) for name in names if hasattr(library, name)]
    return {int(ctypes.cast(function, ctypes.c_void_p).value or 0) for function in found}


def _traced_by(scene: Any) -> tuple[int, int]:
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
