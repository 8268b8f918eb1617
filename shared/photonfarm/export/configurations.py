"""What samples of one configuration share, in a file of its own: its point cloud and its photons.

Shape letters: P points, K photon slots.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonfarm.core.archives import write_arrays
from photonfarm.core.errors import SpecError
from photonfarm.core.records import arrays_of
from photonfarm.data import Sample
from photonfarm.export.settings import Extra
from photonfarm.scene.spec import SceneSpec

FOLDER = "configurations"

OF_CONFIGURATION: tuple[Extra, ...] = ("points", "photons")
"""The extras that are written once per configuration."""

POINT_ARRAYS = ("position", "normal", "albedo", "emission", "present")


def check_extras(spec: SceneSpec, extras: Sequence[Extra]) -> None:
    """Raise SpecError if photons are asked for and the scene has none."""
    if "photons" in extras and not spec.photons.paths:
        raise SpecError(f"--with: 'photons' is not there: scene {spec.name} has photons.paths = 0")


def file_of(folder: Path, key: str) -> Path:
    """The file of the configuration with this content key, in the folder of an export."""
    return folder / FOLDER / f"{key}.npz"


def written(folder: Path) -> Iterator[str]:
    """The content keys of the configurations whose files are there."""
    return (file.stem for file in (folder / FOLDER).glob("[!.]*.npz"))


def write_configuration(file: Path, sample: Sample, extras: Sequence[Extra]) -> None:
    """Write what is asked for of a sample's configuration: points as they stand in it, (P, …), and photons, (K, …)."""
    arrays: dict[str, NDArray[Any]] = {"modification": sample.modification.vector}
    if "points" in extras:
        cloud = sample.point_cloud
        arrays |= {f"point_{name}": np.asarray(getattr(cloud, name)) for name in POINT_ARRAYS}
    if "photons" in extras:
        arrays |= {f"photon_{name}": np.asarray(values) for name, values in arrays_of(sample.photons).items()}
    write_arrays(file, arrays, "exported configuration")
