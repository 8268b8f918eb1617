"""Embree for scenes that change, which the Python module of Mitsuba does not offer, through ctypes.

Mitsuba has Embree build for scenes that never change: one hierarchy over all triangles, with spatial splits, 1 µs a
triangle, at every edit. Embree's low quality, meant for dynamic scenes, makes one hierarchy per mesh and a small one
above them: rebuilds are 4 to 6 times faster, whole edits of the room `room` take 14 instead of 29 ms, and images take
0.9 to 1.02 times as long. Rays meet the same surfaces, except where two surfaces touch; and as light paths learn from
such rays where to start, whole images differ by their noise. So the quality cannot be configured: every worker sets it,
as radiance must follow from keys alone.

Mitsuba also gives Embree every mesh anew at every edit. Told which ones have moved, Embree keeps the hierarchies of the
others, and what it makes is the same: in living-room-2, of 385 837 triangles, an edit of the sofa takes 9 instead of
73 ms of a core, and one of all seven groups 37 instead of 77.

Embree's scene is found in the graph of a ray that is not yet traced, which names two addresses: Embree's entry point
and the scene. Nothing is done unless the first is an address that libembree3 exports, so that the second must be the
scene.
"""

from __future__ import annotations

import ctypes
import platform
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

_LOW, _DYNAMIC = 0, 1  # RTC_BUILD_QUALITY_LOW, RTC_SCENE_FLAG_DYNAMIC
_INDEX, _VERTEX = 0, 1  # RTC_BUFFER_TYPE_
_UINT3, _FLOAT3 = 0x5003, 0x9003  # RTC_FORMAT_
_SET_QUALITY = "_ZN7mitsuba23rtcSetSceneBuildQualityEPNS_10RTCSceneTyENS_15RTCBuildQualityE"
_SET_FLAGS = "_ZN7mitsuba16rtcSetSceneFlagsEPNS_10RTCSceneTyENS_13RTCSceneFlagsE"
_GET_GEOMETRY = "_ZN7mitsuba14rtcGetGeometryEPNS_10RTCSceneTyEj"
_SHARE = "_ZN7mitsuba26rtcSetSharedGeometryBufferEPNS_13RTCGeometryTyENS_13RTCBufferTypeEjNS_9RTCFormatEPKvmmm"
_COMMIT_GEOMETRY = "_ZN7mitsuba17rtcCommitGeometryEPNS_13RTCGeometryTyE"
_COMMIT = "_ZN7mitsuba18rtcJoinCommitSceneEPNS_10RTCSceneTyE"  # on this thread, as Mitsuba does
_CALLED = (_SET_QUALITY, _SET_FLAGS, _GET_GEOMETRY, _SHARE, _COMMIT_GEOMETRY, _COMMIT)
_OCCLUDED = (
    "_ZN7mitsuba12rtcOccluded{n}EPKiPNS_10RTCSceneTyEPNS_19RTCIntersectContextEPNS_7RTCRay{n}E",  # 4 and 8 rays
    "_ZN7mitsuba13rtcOccluded{n}EPKiPNS_10RTCSceneTyEPNS_19RTCIntersectContextEPNS_8RTCRay{n}E",  # 16 rays
)

_POINTER = re.compile(r'^\s*(\d+) \[label="\{Literal: (0x[0-9a-f]+)\|\{Type: LLVM ptr\b', re.MULTILINE)
_TRACE = re.compile(r'^\s*(\d+) \[label="\{trace_ray\|', re.MULTILINE)
_EDGE = re.compile(r"^\s*(\d+) -> (\d+)\b", re.MULTILINE)


class ChangingScene:
    """Embree's scene, whose shapes move one by one."""

    def __init__(self, library: Any, address: int) -> None:
        """Take Embree's scene; it is built for changes from the next rebuild on."""
        self._call, self._address = library, ctypes.c_void_p(address)
        self._get_geometry = getattr(library, _GET_GEOMETRY)
        self._get_geometry.restype = ctypes.c_void_p
        dr.sync_thread()
        getattr(library, _SET_QUALITY)(self._address, ctypes.c_int(_LOW))
        getattr(library, _SET_FLAGS)(self._address, ctypes.c_int(_DYNAMIC))

    def rebuild(self, moved: Mapping[int, Any]) -> None:
        """Have rays meet shapes, by their numbers in Mitsuba's order, where they are now."""
        dr.sync_thread()
        for number, shape in moved.items():
            geometry = ctypes.c_void_p(self._get_geometry(self._address, ctypes.c_uint(number)))
            if shape.is_mesh():
                self._share(geometry, _INDEX, _UINT3, shape.faces_buffer())
                self._share(geometry, _VERTEX, _FLOAT3, shape.vertex_positions_buffer())
            getattr(self._call, _COMMIT_GEOMETRY)(geometry)
        with _flush_denormals():
            getattr(self._call, _COMMIT)(self._address)

    def _share(self, geometry: ctypes.c_void_p, kind: int, form: int, values: Any) -> None:
        """Have a mesh read its buffer at the address where Dr.Jit has its values now, which the mesh keeps."""
        address, rows = values.numpy().ctypes.data, len(values) // 3
        given = ctypes.c_void_p(address), ctypes.c_size_t(0), ctypes.c_size_t(12), ctypes.c_size_t(rows)
        getattr(self._call, _SHARE)(geometry, ctypes.c_int(kind), ctypes.c_uint(0), ctypes.c_int(form), *given)


@contextmanager
def _flush_denormals() -> Iterator[None]:
    """Have this thread take denormal numbers for 0, as Dr.Jit has its own; Embree takes 1.7 times as long otherwise."""
    if platform.machine() != "x86_64":
        yield
        return
    library, environment = ctypes.CDLL("libm.so.6"), (ctypes.c_uint32 * 8)()  # glibc's fenv_t, which ends with MXCSR
    library.fegetenv(environment)
    before = environment[7]
    environment[7] |= 0x8040  # flush to zero, denormals are zero
    library.fesetenv(environment)
    try:
        yield
    finally:
        environment[7] = before
        library.fesetenv(environment)


def expect_changes(scene: Any) -> ChangingScene | None:
    """Embree's scene, which expects changes; None if Embree does not trace (CUDA, another build of Mitsuba).

    Edits keep their cost then.
    """
    library = _open_embree()
    if library is None:
        return None
    entry, accel = _find_embree_scene(scene)
    return ChangingScene(library, accel) if entry in _entry_points(library) else None


def _open_embree() -> Any:
    """The library libembree3 that Mitsuba has loaded; None if it is not loaded, or lacks a function that is called."""
    path = next(Path(mi.__file__).parent.glob("libembree3.so"), None) if mi.variant().startswith("llvm") else None
    library = path and ctypes.CDLL(str(path))
    return library if all(hasattr(library, name) for name in _CALLED) else None


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
