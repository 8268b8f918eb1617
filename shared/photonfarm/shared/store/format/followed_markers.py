"""The markers of a scene, looked at again and again by one process.

In a bucket a listing costs a request for each thousand names, and a look each second would cost hundreds of them. Jobs
are committed about in the order of their numbers; so a look asks for the few that are missing among the first ones, one
by one, and lists what lies behind. In a folder a look lists all.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from photonfarm.shared.core.errors import store_errors
from photonfarm.shared.store.format import markers
from photonfarm.shared.store.io.storage import Ordered, Storage

WHOLE_S = 600.0
"""The seconds after which all markers are listed again: only so is it seen that a repair has set jobs aside."""

LISTED_AT_ONCE = 1000
"""The names in an answer of a bucket."""


class FollowedMarkers:
    """The jobs of a scene that have a marker."""

    def __init__(self, storage: Storage, scene: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Take the folder of a scene; nothing is listed yet."""
        self._storage, self._scene, self._clock = storage, scene, clock
        self._known: set[int] = set()
        self._whole_due = clock()

    def doubt(self) -> None:
        """List all markers at the next look: some may have been removed."""
        self._whole_due = self._clock()

    def look(self) -> set[int]:
        """The jobs that have a marker now.

        In a bucket, one that was there at an earlier look is taken to be there for WHOLE_S, unless there is a doubt.
        """
        now = self._clock()
        if not self._known or now >= self._whole_due or not isinstance(self._storage, Ordered):
            self._known = markers.jobs(self._storage, self._scene)
            self._whole_due = now + WHOLE_S
        else:
            with store_errors("look for markers", f"{self._storage.where}/{self._scene}"):
                self._known |= self._new(self._storage)
        return set(self._known)

    def _new(self, storage: Ordered) -> set[int]:
        """The jobs that were committed since the last look, by the fewest requests."""
        last = max(self._known)
        seen = np.zeros(last + 1, np.bool_)
        seen[list(self._known)] = True
        missing = np.flatnonzero(~seen)
        behind = np.append(missing, last + 1) - 1  # for 0, 1, 2, … of the missing asked for: the name to list behind
        asked = int(np.argmin(np.arange(len(behind)) + (last - behind) // LISTED_AT_ONCE))
        new = {job for job in missing[:asked].tolist() if self._storage.exists(markers.name_of(self._scene, job))}
        after = markers.file_of(int(behind[asked])) if behind[asked] >= 0 else ""
        return new | markers.jobs_named(storage.names_behind(f"{self._scene}/{markers.COMMITTED}", after))
