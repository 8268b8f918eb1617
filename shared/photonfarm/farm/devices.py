"""What renders: a device by its name, and the NVIDIA cards of this machine, found through the driver's own library.

The driver reads CUDA_VISIBLE_DEVICES once in a process, at its first call. So cards are looked for in a child process,
and this one can still choose the card that it shows to Mitsuba. Without a driver no process is started.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import subprocess
import sys
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

from photonfarm.core.errors import BackendError

DEVICE_VARIABLE = "PHOTONFARM_DEVICE"
VISIBLE_VARIABLE = "CUDA_VISIBLE_DEVICES"
ORDER_VARIABLE, ORDER = "CUDA_DEVICE_ORDER", "PCI_BUS_ID"
"""The order in which cards are numbered here: that of nvidia-smi, whatever CUDA thinks which card is fastest."""

AUTO, CPU, CUDA = "auto", "cpu", "cuda"
NAMES = re.compile(r"auto|cpu|cuda(?::(\d+))?")
"""The names of devices: auto (a card where there is a usable one, else the CPU), cpu, cuda (the first card), cuda:N."""

OLDEST_CUDA = 12_02
"""The oldest CUDA that Dr.Jit 1.5 works with, that of driver R535."""

REFUSED_CUDA = 12_07
"""The CUDA with which Dr.Jit 1.5 refuses to trace rays, as it is prone to miscompilation: drivers R559 to R565."""

PROBE_S = 60.0
"""The seconds that a driver may take to list its cards."""

_LIBRARIES = {"cuda": ("DRJIT_LIBCUDA_PATH", "libcuda.so.1"), "optix": ("DRJIT_LIBOPTIX_PATH", "libnvoptix.so.1")}
_MAJOR, _MINOR = 75, 76  # CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_…
_CONTAINER = "in a container, NVIDIA_DRIVER_CAPABILITIES must hold {}"


@dataclass(frozen=True, slots=True)
class Card:
    """An NVIDIA card that this process may use."""

    number: int  # as in `cuda:N`: among the cards that CUDA_VISIBLE_DEVICES leaves, in the order of nvidia-smi
    name: str
    capability: str  # compute capability, such as "9.0"
    memory_bytes: int


@dataclass(frozen=True, slots=True)
class Cards:
    """The cards of this machine, and its driver."""

    cards: tuple[Card, ...] = ()
    driver: str = ""  # its version, such as "550.54.15"; "" if nothing states it
    cuda: int = 0  # the newest CUDA that it works with: 100 · major + minor
    trouble: str = ""  # why none of them can render, as a sentence; "" if they can

    def card(self, name: str) -> Card | None:
        """The card that a device's name stands for; None for the CPU.

        Raises BackendError for a name that is none, and for a card that is not there or cannot render.
        """
        match = NAMES.fullmatch(name)
        if match is None:
            raise BackendError(f"device = {name!r}: must be {AUTO}, {CPU}, {CUDA} or {CUDA}:N")
        if name == CPU or (name == AUTO and self.trouble):
            return None
        if self.trouble:
            raise BackendError(f"device {name} cannot render here: {self.trouble}; --device {CPU} renders without")
        number = int(match[1] or 0)
        if number >= len(self.cards):
            there = ", ".join(f"{CUDA}:{card.number} ({card.name})" for card in self.cards)
            raise BackendError(f"device {name}: this machine has no such card; there is {there}")
        return self.cards[number]


def worker_devices(name: str, cards: Cards) -> tuple[str, ...]:
    """The devices that several workers take in turn: of `auto` and `cuda` every card, otherwise the one named.

    Raises BackendError as `Cards.card` does.
    """
    if cards.card(name) is None:
        return (CPU,)
    return tuple(f"{CUDA}:{card.number}" for card in cards.cards) if name in (AUTO, CUDA) else (name,)


def is_card_wanted(name: str) -> bool:
    """Whether a device's name stands for a card, wherever that is: by its name, or for `auto` as this machine has one.

    That workers run where plans are made is a guess.
    """
    return name.startswith(CUDA) or (name == AUTO and not cards_here().trouble)


def visible_device(card: Card) -> str:
    """The value of CUDA_VISIBLE_DEVICES that leaves this card alone, within what it leaves already."""
    visible = [each.strip() for each in os.environ.get(VISIBLE_VARIABLE, "").split(",") if each.strip()]
    return visible[card.number] if card.number < len(visible) else str(card.number)


@cache
def cards_here() -> Cards:
    """The cards of this machine; they are looked for once in a process."""
    if (missing := _find_unopened("cuda")) is not None:
        return Cards(trouble=f"there is no NVIDIA driver ({missing}; {_CONTAINER.format('compute')})")
    command, environment = [sys.executable, "-m", __name__], {**os.environ, ORDER_VARIABLE: ORDER}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=PROBE_S)
        document = json.loads(done.stdout)
        return Cards(**{**document, "cards": tuple(Card(**card) for card in document["cards"])})
    except (subprocess.SubprocessError, ValueError, KeyError, TypeError) as error:
        return Cards(trouble=f"the NVIDIA driver did not list its cards ({' '.join(str(error).split())})")


def list_cards() -> Cards:
    """The cards of this machine, asked for in this process, which then cannot choose among them any more."""
    library = ctypes.CDLL(_path("cuda"))
    if failed := library.cuInit(0):
        said = ctypes.c_char_p()
        library.cuGetErrorString(failed, ctypes.byref(said))
        why = said.value.decode(errors="replace") if said.value else f"error {failed}"
        return Cards((), _driver_version(), 0, f"there is no usable NVIDIA card (cuInit: {why})")
    version, count = ctypes.c_int(), ctypes.c_int()
    library.cuDriverGetVersion(ctypes.byref(version))
    library.cuDeviceGetCount(ctypes.byref(count))
    cards = tuple(_describe_card(library, number) for number in range(count.value))
    cuda = version.value // 10
    return Cards(cards, _driver_version(), cuda, _find_trouble(len(cards), cuda, _find_unopened("optix")))


def _find_trouble(cards: int, cuda: int, no_optix: str | None) -> str:
    """Why cards that are listed cannot render; "" if they can."""
    says = f"it works with CUDA {cuda // 100}.{cuda % 100}"
    if not cards:
        return f"the NVIDIA driver shows no card; {VISIBLE_VARIABLE} may hide them all"
    if cuda < OLDEST_CUDA:
        return f"the NVIDIA driver is too old ({says}); Mitsuba needs R535 or newer"
    if cuda == REFUSED_CUDA:
        return f"Dr.Jit refuses this NVIDIA driver as faulty ({says}); use one below R559, or R570 and newer"
    if no_optix is not None:
        return f"OptiX is missing ({no_optix}; {_CONTAINER.format('graphics')})"
    return ""


def _describe_card(library: Any, number: int) -> Card:
    device, name, memory = ctypes.c_int(), ctypes.create_string_buffer(256), ctypes.c_size_t()
    library.cuDeviceGet(ctypes.byref(device), number)
    library.cuDeviceGetName(name, len(name), device)
    library.cuDeviceTotalMem_v2(ctypes.byref(memory), device)
    capability = []
    for attribute in (_MAJOR, _MINOR):
        value = ctypes.c_int()
        library.cuDeviceGetAttribute(ctypes.byref(value), attribute, device)
        capability.append(str(value.value))
    return Card(number, name.value.decode(errors="replace"), ".".join(capability), memory.value)


def _driver_version() -> str:
    """The driver's version, by the library of nvidia-smi; "" if that is not here, or does not say it."""
    try:
        library = ctypes.CDLL("libnvidia-ml.so.1")
    except OSError:
        return ""
    version = ctypes.create_string_buffer(96)
    if library.nvmlInit_v2() or library.nvmlSystemGetDriverVersion(version, len(version)):
        return ""
    return version.value.decode(errors="replace")


def _path(library: str) -> str:
    """The library of the driver, where Dr.Jit looks for it."""
    variable, name = _LIBRARIES[library]
    return os.environ.get(variable) or name


def _find_unopened(library: str) -> str | None:
    """Why a library of the driver cannot be opened; None if it can."""
    try:
        ctypes.CDLL(_path(library))
    except OSError as error:
        return str(error)
    return None


if __name__ == "__main__":
    json.dump(asdict(list_cards()), sys.stdout)
