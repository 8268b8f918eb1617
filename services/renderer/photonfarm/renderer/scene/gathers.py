"""Gather instructions on processors for which LLVM avoids them to Dr.Jit's cost.

Without AVX-512, LLVM gathers by instruction only on processors that it tunes for fast gathers, and none of AMD's are
among them. On others it loads lane by lane, each lane behind a branch. Kernels that shade surfaces gather all the time:
on Zen 3 they are faster with the instruction, and give the same bits. No other processor has been measured, so that
all others keep LLVM's choice.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

FASTER_ON = frozenset({"znver3"})
"""The processors, by LLVM's names, on which kernels are faster with gather instructions than with LLVM's choice."""

FEATURE = "+fast-gather"


def features_for(cpu: str, features: str) -> str:
    """LLVM's features of a processor, with that of fast gathers where kernels are faster by it."""
    if cpu not in FASTER_ON or FEATURE in features.split(","):
        return features
    return f"{features},{FEATURE}"


def use_where_faster() -> None:
    """Kernels that Dr.Jit compiles from now on gather by instruction, if that is faster here; LLVM must be loaded.

    The functions are those of drjit-core/jit.h, which Dr.Jit's Python does not have.
    """
    library = _dr_jit()
    cpu, features = target()
    tuned = features_for(cpu, features)
    if tuned != features:
        library._Z19jit_llvm_set_targetPKcS0_j(
            cpu.encode(), tuned.encode(), ctypes.c_uint32(library._Z21jit_llvm_vector_widthv())
        )


def target() -> tuple[str, str]:
    """(processor, its features): what Dr.Jit compiles for, in LLVM's names, features with commas between them."""
    library = _dr_jit()
    found = []
    for name in ("_Z19jit_llvm_target_cpuv", "_Z24jit_llvm_target_featuresv"):
        function = library[name]
        function.restype = ctypes.c_char_p
        found.append((function() or b"").decode())
    return found[0], found[1]


def _dr_jit() -> ctypes.CDLL:
    import drjit

    return ctypes.CDLL(str(next(Path(drjit.__file__).parent.glob("libdrjit-core.*"))))
