"""Gather instructions for Dr.Jit's kernels, on processors where LLVM avoids them although they are faster.

Without AVX-512, LLVM uses gather instructions only on processors whose gathers it holds to be fast. None of AMD's are
among them. Elsewhere it loads one lane after the other, with a branch for each. Kernels that shade surfaces gather
often. On Zen 3 they take a fifth less time with the instruction (docs/results/cost.md), and results have the same
bits. No other processor has been measured, so all others keep LLVM's choice.
"""

from __future__ import annotations

import ctypes

from photonfarm.renderer.scene.native.libraries import library_of

FASTER_ON = frozenset({"znver3"})
"""Processors, by LLVM's names, on which kernels are faster with gather instructions."""

FEATURE = "+fast-gather"

_CPU, _FEATURES = "_Z19jit_llvm_target_cpuv", "_Z24jit_llvm_target_featuresv"
_WIDTH, _SET = "_Z21jit_llvm_vector_widthv", "_Z19jit_llvm_set_targetPKcS0_j"


def use_where_faster() -> None:
    """Have Dr.Jit use gather instructions in the kernels that it compiles from now on, if they are faster here."""
    cpu, features = target()
    if cpu in FASTER_ON and FEATURE not in features.split(","):
        set_features(f"{features},{FEATURE}")


def target() -> tuple[str, str]:
    """The processor that Dr.Jit compiles for and its features, separated by commas, in LLVM's names; "" if unknown."""
    library = _dr_jit()
    return ("", "") if library is None else (_text(library, _CPU), _text(library, _FEATURES))


def set_features(features: str) -> None:
    """Have Dr.Jit compile for these features of the processor from now on; `target` tells which there are.

    Nothing happens if LLVM is not in use. The functions are declared in drjit-core/jit.h; Dr.Jit's Python module does
    not offer them.
    """
    library = _dr_jit()
    if library is None:
        return
    cpu = target()[0]  # waits until LLVM is initialised, which the width does not
    width = ctypes.c_uint32(getattr(library, _WIDTH)())
    getattr(library, _SET)(cpu.encode(), features.encode(), width)


def _text(library: ctypes.CDLL, name: str) -> str:
    function = getattr(library, name)
    function.restype = ctypes.c_char_p
    return (function() or b"").decode()


def _dr_jit() -> ctypes.CDLL | None:
    import drjit

    return library_of(drjit, "libdrjit-core.*", (_CPU, _FEATURES, _WIDTH, _SET))
