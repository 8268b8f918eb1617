"""Halves of another scene of the store, with the same radiance, and other buffers, guides, photons or points."""

from __future__ import annotations

from pathlib import Path

from photonfarm.shared.core.keys import Key
from photonfarm.shared.core.records import F32
from photonfarm.shared.store import SceneReader


class OtherHalves:
    """The complete samples of a scene with the same radiance id, by their content keys."""

    def __init__(self, store: str | Path, scene_id: str) -> None:
        """Look at what is complete now."""
        self._reader = SceneReader(store, scene_id)
        self._reader.refresh()
        self._rows = self._reader.rows_by_key()

    def find(self, key: Key) -> F32 | None:
        """The halves of a sample, (2, H, W, 3) linear, unscaled, every byte checked; None if it is not complete there.

        Raises CorruptError if bytes are not what was committed.
        """
        row = self._rows.get(key)
        return None if row is None else self._reader.read_radiance(row)
