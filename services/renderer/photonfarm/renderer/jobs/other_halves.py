"""Halves of another scene of the store, with the same radiance, and other buffers, guides, photons or points."""

from __future__ import annotations

import logging
from pathlib import Path

from photonfarm.shared.core.errors import CorruptError, IncompleteError
from photonfarm.shared.core.keys import Key
from photonfarm.shared.core.records import F32
from photonfarm.shared.store import SceneReader

log = logging.getLogger(__name__)


class OtherHalves:
    """The complete samples of a scene with the same radiance id, by their content keys.

    What is damaged there, or gone meanwhile, is not found, and so it is rendered.
    """

    def __init__(self, store: str | Path, scene_id: str) -> None:
        """Take the scene; `refresh` looks what is complete."""
        self._scene_id, self._reader = scene_id, SceneReader(store, scene_id)
        self._rows: dict[Key, int] = {}

    def refresh(self) -> None:
        """Look what is complete now."""
        try:
            if len(self._reader.refresh()):
                self._rows = self._reader.rows_by_key()
        except (CorruptError, IncompleteError) as error:
            self._rows = {}
            log.warning("no halves are taken over from scene %s: %s", self._scene_id, error)

    def find(self, key: Key) -> F32 | None:
        """The halves of a sample, (2, H, W, 3) linear, unscaled, every byte checked; None if they are not there."""
        row = self._rows.get(key)
        if row is None:
            return None
        try:
            return self._reader.read_radiance(row)
        except (CorruptError, IncompleteError) as error:
            log.warning("halves of sample %s are rendered: %s", key.hex(), error)
            return None
