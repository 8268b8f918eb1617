"""Two settings that the Python modules of Mitsuba and Dr.Jit do not offer, made in their libraries through ctypes.

**Embree's build quality.** Mitsuba has Embree build for scenes that never change: one hierarchy over all triangles,
with spatial splits, 1 µs a triangle, at every edit. Embree's low quality, meant for dynamic scenes, makes one hierarchy
per mesh and a small one above them: rebuilds are 4 to 6 times faster, whole edits of the room `room` twice (14 instead
of 29 ms), and images take 0.9 to 1.02 times as long. Rays meet the same surfaces, except where two surfaces touch; and
as guides are learned from such rays, whole images differ by their noise. So the quality is no option: every worker sets
it, as radiance must follow from keys alone. Embree's scene is found in the graph of a ray that is not yet traced, which
names two addresses: Embree's entry point and the scene. Nothing is done unless the first is an address that libembree3
exports, so that the second must be the scene.

**LLVM's gather instructions**, if PHOTONFARM_GATHERS is 1. Without AVX-512, LLVM uses gather instructions only on
processors whose gathers it holds to be fast; none of AMD's are among them. Elsewhere it loads one lane after the other,
with a branch for each. On Zen 3 kernels took 0.82 times as long with the instruction, with the same bits
(docs/results/cost.md). No other processor has been measured.
"""

from __future__ import annotations

import ctypes
import os
import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from photonfarm.core.errors import BackendError

GATHERS_VARIABLE = "PHOTONFARM_GATHERS"

FEATURE = "+fast-gather"

_CPU, _FEATURES = "_Z19jit_llvm_target_cpuv", "_Z24jit_llvm_target_featuresv"
_WIDTH, _SET = "_Z21jit_llvm_vector_widthv", "_Z19jit_llvm_set_targetPKcS0_j"

_LOW = 0  # RTC_BUILD_QUALITY_LOW
_SET_QUALITY = "_ZN7mitsuba23rtcSetSceneBuildQualityEPNS_10RTCSceneTyENS_15RTCBuildQualityE"
_OCCLUDED = (
    "_ZN7mitsuba12rtcOccluded{n}EPKiPNS_10RTCSceneTyEPNS_19RTCIntersectContextEPNS_7RTCRay{n}E",  # 4 and 8 rays
    "_ZN7mitsuba13rtcOccluded{n}EPKiPNS_10RTCSceneTyEPNS_19RTCIntersectContextEPNS_8RTCRay{n}E",  # 16 rays
)

_POINTER = re.compile(r'^\s*(\d+) \[label="\{Literal: (0x[0-9a-f]+)\|\{Type: LLVM ptr\b', re.MULTILINE)
_TRACE = re.compile(r'^\s*(\d+) \[label="\{trace_ray\|', re.MULTILINE)
_EDGE = re.compile(r"^\s*(\d+) -> (\d+)\b", re.MULTILINE)


def _open_library(module: ModuleType, pattern: str, functions: Iterable[str]) -> ctypes.CDLL | None:
    """The library beside a module whose name matches a pattern; None if it is not there or lacks a function."""
    path = next(Path(module.__file__ or "").parent.glob(pattern), None)
    if path is None:
        return None
    library = ctypes.CDLL(str(path))
    return library if all(hasattr(library, name) for name in functions) else None


# ---------------------------------------- LLVM's gather instructions ----------------------------------------


def use_gathers_if_asked() -> None:
    """Have Dr.Jit use gather instructions in the kernels that it compiles from now on, if PHOTONFARM_GATHERS is 1.

    Raises BackendError for values of it that are neither 0 nor 1.
    """
    asked = os.environ.get(GATHERS_VARIABLE) or "0"
    if asked not in ("0", "1"):
        raise BackendError(f"{GATHERS_VARIABLE} is {asked!r}; 0 and 1 are allowed: set 1 for gather instructions")
    features = target()[1]
    if asked == "1" and FEATURE not in features.split(","):
        set_features(f"{features},{FEATURE}")


def target() -> tuple[str, str]:
    """The processor that Dr.Jit compiles for and its features, separated by commas, in LLVM's names; "" if unknown."""
    library = _open_dr_jit()
    return ("", "") if library is None else (_call_for_text(library, _CPU), _call_for_text(library, _FEATURES))


def set_features(features: str) -> None:
    """Have Dr.Jit compile for these features of the processor from now on; `target` tells which there are.

    Nothing happens if LLVM is not in use. The functions are declared in drjit-core/jit.h.
    """
    library = _open_dr_jit()
    if library is None:
        return
    cpu = target()[0]  # waits until LLVM is initialised, which the width does not
    width = ctypes.c_uint32(getattr(library, _WIDTH)())
    getattr(library, _SET)(cpu.encode(), features.encode(), width)


def _call_for_text(library: ctypes.CDLL, name: str) -> str:
    function = getattr(library, name)
    function.restype = ctypes.c_char_p
    return (function() or b"").decode()


def _open_dr_jit() -> ctypes.CDLL | None:
    import drjit

    return _open_library(drjit, "libdrjit-core.*", (_CPU, _FEATURES, _WIDTH, _SET))


# ---------------------------------------- Embree's build quality ----------------------------------------


def expect_changes(scene: Any) -> bool:
    """Have Embree build the scene for changes from its next rebuild on.

    Returns whether it will: False if Embree does not trace (CUDA, another build of Mitsuba), where edits keep their
    cost.
    """
    import drjit as dr

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
    """The library libembree3 that Mitsuba has loaded, with the functions needed; None if it is not loaded."""
    import mitsuba as mi

    return _open_library(mi, "libembree3.so", (_SET_QUALITY,)) if mi.variant().startswith("llvm") else None


def _entry_points(library: Any) -> set[int]:
    """The addresses of Embree's functions that test 4, 8 or 16 shadow rays."""
    names = {pattern.format(n=n) for pattern in _OCCLUDED for n in (4, 8, 16)}
    functions = [getattr(library, name) for name in names if hasattr(library, name)]
    return {int(ctypes.cast(function, ctypes.c_void_p).value or 0) for function in functions}


def _find_embree_scene(scene: Any) -> tuple[int, int]:
    """The addresses of the function that traces a shadow ray here, and of Embree's scene; zeros if not found."""
    import drjit as dr
    import mitsuba as mi

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
