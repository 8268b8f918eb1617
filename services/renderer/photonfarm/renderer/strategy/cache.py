"""Measurements kept on this machine, one JSON file each, under a digest of all that they depend on."""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path

from pydantic import ValidationError

from photonfarm.renderer.jobs.render import versions
from photonfarm.renderer.scene import backend
from photonfarm.renderer.strategy.measurement import GRID, Measurement
from photonfarm.renderer.strategy.objective.purpose import Purpose
from photonfarm.shared.core.files import write_whole
from photonfarm.shared.core.keys import make_key
from photonfarm.shared.scene.spec import SceneSpec, Transport

_DECIDED = ("connections", "light_ratio", "half_spp", "guided_light", "light_samples")


def digest(spec: SceneSpec, purpose: Purpose) -> str:
    """32 hexadecimal digits: the scene without what a plan decides, the purpose, the candidates, machine, and code.

    So a plan that is written into its spec does not require another one. For training the guides count, whose time
    belongs to a sample.
    """
    default = Transport()
    undecided = spec.transport.model_copy(update={name: getattr(default, name) for name in _DECIDED})
    scene = spec.model_copy(update={"transport": undecided})
    known = scene.radiance_id, str(undecided.rr_depth), repr(spec.exposure), str(spec.points)
    guides = [spec.guides.model_dump_json()] if purpose is Purpose.TRAINING else []
    return digest_here("scene plan", *known, repr(GRID), purpose.value, *guides)


def digest_here(*parts: str) -> str:
    """32 hexadecimal digits: the `parts` that identify a measurement, the machine, and all code that renders."""
    return make_key(*parts, repr(_machine()), _revision()).hex()


def _machine() -> tuple[object, ...]:
    """All that times depend on beside the scene and the code: processor, cores, device, versions of the packages.

    The number of threads is not among them, as a pilot has one.
    """
    device = backend.device()
    return _processor(), os.cpu_count(), device.variant, device.name, sorted(versions().items())


def _processor() -> str:
    """The model's name, if the system states it; else its kind."""
    try:
        described = Path("/proc/cpuinfo").read_text()
    except OSError:
        described = ""
    names = [line.partition(":")[2].strip() for line in described.splitlines() if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _revision() -> bytes:
    """A digest of the renderer's source: a checkout has one version for many renderers.

    It leaves out how configurations and views are drawn: that never changes, since the keys of stored samples depend on
    it.
    """
    hashed = hashlib.sha256()
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        hashed.update(file.read_bytes())
    return hashed.digest()


def file_of(folder: str, digest: str) -> Path:
    """The file of a measurement; each kind has a folder of its own."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "photonfarm" / folder / f"{digest}.json"


def _file(spec: SceneSpec, purpose: Purpose) -> Path:
    return file_of("plans", digest(spec, purpose))


def find(spec: SceneSpec, purpose: Purpose) -> Measurement | None:
    """The kept measurement of this scene for a purpose; None if it is missing, unreadable or unusable."""
    try:
        return Measurement.model_validate_json(_file(spec, purpose).read_bytes())
    except (OSError, ValidationError):
        return None


def keep(spec: SceneSpec, measurement: Measurement) -> Path:
    """Keep a measurement; returns its file, which appears whole. Raises OSError if it cannot be written."""
    file = _file(spec, measurement.purpose)
    write_whole(file, measurement.model_dump_json(indent=1) + "\n")
    return file
