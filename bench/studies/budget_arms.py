"""How a budget of core-seconds is shared out between configurations, views, passes and samples per pixel.

Everything is rendered in passes of 2 samples per pixel, of which samples of more are put together; each is charged what
it would cost rendered at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from bench.harness.room_study import HELD_OUT, ChosenSamples
from photonfarm.core.records import Guides, ViewBuffers
from photonfarm.plan.request import Request
from photonfarm.store.read.batch import Batch, Sample
from photonfarm.store.read.reader import SceneReader

HALF_SPP = 1  # of what is rendered
PASS_SPP = 2 * HALF_SPP

Images = TypeVar("Images", ViewBuffers, Guides)


@dataclass(frozen=True, slots=True)
class Share:
    """What each configuration gets."""

    spp: int  # of a sample, both halves together; even
    views: int
    passes: int  # samples of each view

    @property
    def rendered(self) -> int:
        """Passes of `PASS_SPP` that each view needs."""
        return self.passes * self.spp // PASS_SPP

    def __str__(self) -> str:
        return f"{self.spp}-spp-{self.views}-views-{self.passes}-passes"


SHARES = (
    Share(2, 1, 1), Share(8, 1, 1), Share(32, 1, 1), Share(128, 1, 1),
    Share(2, 4, 1), Share(8, 4, 1), Share(32, 4, 1), Share(2, 1, 4),
)  # fmt: skip


class ArmSamples(ChosenSamples):
    """The training samples of one share: some configurations of a store, each with what the share gives it.

    A sample's halves are means of the halves of `spp` / 2 passes of its view. An arm of a slice holds every `slices`-th
    configuration that has enough, so that arms of two slices share none, and arms with fewer configurations hold some
    of those that larger ones of their slice hold.
    """

    def __init__(
        self, root: Path, scene_id: str, share: Share, configurations: int, slice_: tuple[int, int] = (0, 1)
    ) -> None:
        """Choose from a slice: its number, and how many there are. Raises ValueError where the store has too few."""
        super().__init__(root, scene_id, HELD_OUT)
        reader = SceneReader(root, scene_id)
        reader.refresh()
        enough = _enough(reader, self.trainable, share)
        number, slices = slice_
        chosen = enough[number::slices][:configurations]
        if len(chosen) < configurations:
            raise ValueError(
                f"slice {number} of {slices}: {len(chosen)} configurations have {share.views} views of "
                f"{share.rendered} passes, and {configurations} are needed"
            )
        together = share.spp // PASS_SPP
        self._passes = {
            view[start]: view[start : start + together]
            for views in chosen
            for view in views
            for start in range(0, share.rendered, together)
        }
        self.chosen = list(self._passes)

    def read_samples(self, rows: Sequence[int], out: Batch | None = None) -> list[Sample]:  # noqa: ARG002
        """The chosen samples of these rows, and the one that is held out as it is."""
        return [self._mean(row) for row in rows]

    def _mean(self, row: int) -> Sample:
        passes = Batch.empty(self.spec, len(self._passes.get(row, [row])), guides=True)
        read = [sample.decoded() for sample in super().read_samples(self._passes.get(row, [row]), passes)]
        return replace(read[0], radiance=np.mean([sample.radiance for sample in read], axis=0))


def _enough(reader: SceneReader, rows: Sequence[int], share: Share) -> list[list[list[int]]]:
    """The configurations with enough passes of enough views: of each its first views, of these all passes' rows."""
    views: dict[bytes, dict[int, None]] = {}
    for row, key in zip(rows, reader.modification_keys(list(rows)), strict=True):
        views.setdefault(key, {})[reader.view_row(row)] = None
    found = []
    for of in views.values():
        passes = (reader.rows_of_view(view).tolist() for view in sorted(of))
        enough = [rows for rows in passes if len(rows) >= share.rendered][: share.views]
        if len(enough) == share.views:
            found.append(enough)
    return found


def requests(configurations: dict[Share, int], slices: int, seed: int) -> list[Request]:
    """What gives each share so many configurations in each slice, and some more that are held out."""
    return [
        Request(
            modifications=(needed := slices * count) + needed // 8 + 16,
            views_per_modification=share.views,
            passes=share.rendered,
            seed=seed,
        )
        for share, count in sorted(configurations.items(), key=lambda item: -item[0].rendered)
    ]
