"""The set-up of Mitsuba: device and variant are chosen, LLVM is found, the integrator plugin registered, all here.

What renders is a card of NVIDIA's or the processor, by PHOTONFARM_DEVICE, which `--device` sets. One process uses one
card: the others are hidden from it before Mitsuba is imported, as CUDA looks but once. A card needs no LLVM.

On the processor Dr.Jit compiles through a libLLVM that it opens by itself. On machines with AVX-512 LLVM 15 and 16
crash on Mitsuba's kernels ("Cannot select"), so that only versions known to work are chosen by default;
DRJIT_LIBLLVM_PATH overrides.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from photonfarm.core.errors import BackendError, say_install
from photonfarm.farm import devices
from photonfarm.farm.devices import AUTO, CPU, CUDA, DEVICE_VARIABLE, Card

if TYPE_CHECKING:
    from photonfarm.scene.spec import SceneSpec

LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
VARIANT_VARIABLE = "PHOTONFARM_VARIANT"
DEFAULT_VARIANT = "llvm_ad_rgb"
CARD_VARIANT = "cuda_ad_rgb"
LLVM_VERSIONS = ("19", "22")
"""The versions tested with Mitsuba's kernels, in order of preference."""

PATH_BYTES = 192
"""Memory for each path of a launch: the kept vertex of a light path, 128 bytes, and what kernels hand on to others."""

MEMORY_SHARE = 4
"""One over the share of a card's memory that paths may take."""

MOST_PATHS = 1 << 25
"""The most paths in a launch: a hundred and more for each thread of a large card, which leaves nothing to fill."""

_FOLDERS = ("lib/*-linux-gnu", "lib64", "lib", "lib/llvm-*/lib", "local/lib")
_INSTALL_LLVM = f"install LLVM 19 (Debian and Ubuntu: libllvm19), or set {LLVM_VARIABLE} to a libLLVM"


log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Device:
    """What renders in this process."""

    variant: str
    card: Card | None  # None: the processor
    driver: str  # of the card; "" for the processor

    @property
    def name(self) -> str:
        """The name that markers give it: that of the card, or "cpu"."""
        return self.card.name if self.card else CPU


def device() -> Device:
    """What renders in this process, by PHOTONFARM_DEVICE and PHOTONFARM_VARIANT; Mitsuba need not be there.

    Raises BackendError for a device that is not there or cannot render, and for a variant of another device.
    """
    return _device(os.environ.get(DEVICE_VARIABLE) or AUTO, os.environ.get(VARIANT_VARIABLE) or "")


@cache
def _device(name: str, variant: str) -> Device:
    if variant and name == AUTO:
        name = CUDA if variant.startswith(CUDA) else CPU
    if variant and (variant.startswith(CUDA)) != name.startswith(CUDA):
        raise BackendError(
            f"{VARIANT_VARIABLE} = {variant!r} is no variant for the device {name}; leave one of the two out"
        )
    cards = devices.cards_here() if name != CPU else devices.Cards()
    card = cards.card(name)
    if card is None and cards.cards:
        log.warning("rendering on the CPU, as %s", cards.trouble)
    return Device(variant or (CARD_VARIANT if card else DEFAULT_VARIANT), card, cards.driver if card else "")


def paths_at_once() -> int | None:
    """The most eye or light paths in a launch on the card, by its memory; None on a processor.

    A quarter of the memory is for them, as the scene, other processes and a trainer may need theirs. MOST_PATHS bounds
    them, which has not been measured on a card.
    """
    card = device().card
    return None if card is None else max(1, min(card.memory_bytes // MEMORY_SHARE // PATH_BYTES, MOST_PATHS))


def for_this_device(spec: SceneSpec) -> SceneSpec:
    """The spec with the strategy that it has for what renders in this process."""
    return spec.model_copy(update={"transport": spec.transport.on_card}) if device().card else spec


def work_s() -> float:
    """Seconds of rendering so far, to be subtracted: of the processor where that renders, else as a clock goes."""
    return time.perf_counter() if device().card else time.process_time()


def load(threads: int | None = None) -> Any:
    """Return the module `mitsuba` with its variant set and the plugin `bdpt` registered; later calls are cheap.

    `threads` is the size of Dr.Jit's thread pool (1 for a worker: two processes of one thread beat one of two).
    Raises BackendError, with one sentence on what to install or to set.
    """
    chosen = device()
    if chosen.card and "mitsuba" not in sys.modules:
        os.environ[devices.ORDER_VARIABLE] = devices.ORDER
        os.environ[devices.VISIBLE_VARIABLE] = devices.visible_device(chosen.card)
    if chosen.variant.startswith("llvm"):
        os.environ[LLVM_VARIABLE] = find_llvm()
    mitsuba, drjit = _import("mitsuba"), _import("drjit")
    _set_variant(mitsuba, chosen.variant)
    if threads is not None:
        drjit.set_thread_count(threads)
    _import("photonfarm.renderer.bdpt")
    return mitsuba


def find_llvm(roots: Iterable[Path] = (Path(sys.prefix), Path("/usr"))) -> str:
    """The libLLVM to use: the one that DRJIT_LIBLLVM_PATH names, else a version that works in a library folder.

    Raises BackendError if there is none, or if it cannot be opened.
    """
    named = os.environ.get(LLVM_VARIABLE)
    if named:
        return _open_llvm(named, f"{LLVM_VARIABLE} = {named!r} cannot be opened")
    for version in LLVM_VERSIONS:
        for library in _libraries(roots, version):
            return _open_llvm(str(library), f"{library} cannot be opened")
    raise BackendError(f"no libLLVM of version {' or '.join(LLVM_VERSIONS)} is installed; {_INSTALL_LLVM}")


def _libraries(roots: Iterable[Path], version: str) -> Iterable[Path]:
    for root in roots:
        for folder in _FOLDERS:
            for pattern in (f"libLLVM-{version}.so", f"libLLVM.so.{version}.*", f"libLLVM-{version}.so.*"):
                yield from sorted(root.glob(f"{folder}/{pattern}"))


def _open_llvm(library: str, failure: str) -> str:
    try:
        ctypes.CDLL(library)
    except OSError as error:
        raise BackendError(f"{failure} ({error}); {_INSTALL_LLVM}") from error
    return library


def _import(name: str) -> Any:
    """Import a module; without libatomic, Dr.Jit fails with a NameError that does not mention it."""
    try:
        return importlib.import_module(name)
    except NameError as error:
        raise BackendError(
            f"{name} cannot be imported ({error}); its libraries need libatomic: install libatomic1 (Debian and Ubuntu)"
        ) from error
    except ModuleNotFoundError as error:
        raise BackendError(f"{name} is not installed ({error}); {say_install('render')}") from error
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        raise BackendError(f"{name} cannot be imported: {error}") from error


def _set_variant(mitsuba: Any, variant: str) -> None:
    if variant not in mitsuba.variants():
        known = ", ".join(v for v in mitsuba.variants() if v.endswith("_rgb"))
        raise BackendError(f"{VARIANT_VARIABLE} = {variant!r} is not a variant of this Mitsuba; known: {known}")
    if mitsuba.variant() == variant:
        return
    try:
        mitsuba.set_variant(variant)
    except (ImportError, OSError, RuntimeError) as error:
        raise BackendError(f"Mitsuba's variant {variant!r} cannot be used here: {error}") from error
