"""The stream of training batches from a growing store, at a pace limited by its growth."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Self

import torch

from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.data.sampler import RoundSampler
from photonfarm.trainer.runs.distributed import SINGLE_PROCESS, TrainingGroup
from photonfarm.trainer.runs.settings import TrainSettings


@dataclass(frozen=True, slots=True)
class Growth:
    """The rows that arrived, and when; together with the seed they determine the order of training.

    A run's checkpoint has all of it, as `following.arrived` and `following.growth`. metrics.jsonl has a summary: each
    of its records has the number of drawn and of arrived samples.
    """

    rows: list[int] = field(default_factory=list)  # in order of arrival, training and held-out rows
    log: list[tuple[int, int]] = field(default_factory=list)  # (batches drawn by then, rows that had arrived)
    drawn: int = 0  # batches drawn when this was saved

    @classmethod
    def of(cls, state: dict[str, Any]) -> Self:
        """The growth of a run, from the `following` of its checkpoint."""
        log = [(drawn, arrived) for drawn, arrived in state["growth"].tolist()]
        return cls(state["arrived"].tolist(), log, state["drawn"])

    def visible(self, drawn: int) -> int | None:
        """The number of rows that had arrived when batch `drawn` was drawn; None for a batch not drawn by then."""
        if drawn >= self.drawn:
            return None
        place = bisect_right(self.log, drawn, key=lambda entry: entry[0])
        return self.log[place - 1][1] if place else 0


class BatchStream:
    """Draws batches, and has them read, ahead of training. A `script` is the growth of an earlier run to repeat."""

    def __init__(
        self, feed: Feed, settings: TrainSettings, script: Growth | None = None, group: TrainingGroup = SINGLE_PROCESS
    ) -> None:
        """Draw batches for all processes of a group, and read this process's part of them."""
        self._feed, self._settings, self._group = feed, settings, group
        self._script = script or Growth()
        self._sampler = RoundSampler(settings.seed, settings.catch_up)
        self._waiting: dict[int, bool] = {}  # arrived, not yet visible: row → held out
        self._known: set[int] = set()
        self._asked: deque[tuple[int, ...]] = deque()  # drawn, not yet trained on
        self._restored: list[tuple[int, ...]] = []  # the same of an earlier session, not requested in this one yet
        self._complete = False
        self.growth = Growth()
        self.held_out: list[int] = []
        self.drawn = 0  # batches

    @property
    def training_rows(self) -> list[int]:
        """The visible rows that are not held out, in order of arrival."""
        return self._sampler.rows

    @property
    def complete(self) -> bool:
        """Whether everything planned has arrived and is visible."""
        return self._complete

    def look(self) -> None:
        """Make arrived rows visible; with a script, only the rows that it lists up to this batch."""
        rows, complete = self._feed.arrivals()
        self._waiting.update((row, held) for row, held in rows if row not in self._known)
        scripted = self._script.visible(self.drawn)
        if scripted is None:
            self._show(list(self._waiting))
        else:
            due = self._script.rows[len(self.growth.rows) : scripted]
            self._show(due if all(row in self._waiting for row in due) else [])
        self._complete = complete and not self._waiting

    def _show(self, rows: list[int]) -> None:
        if not rows:
            return
        held = {row: self._waiting.pop(row) for row in rows}
        self._known.update(rows)
        self.growth.rows.extend(rows)
        self.growth.log.append((self.drawn, len(self.growth.rows)))
        self.held_out.extend(row for row in rows if held[row])
        self._sampler.add([row for row in rows if not held[row]])

    def may_draw(self) -> bool:
        """Whether another batch may be drawn: draws ≤ R × arrived + buffer, and `minimum_samples` have arrived.

        Neither limit applies once everything planned has arrived. With a script, a batch is drawn when exactly the
        scripted rows are visible.
        """
        scripted = self._script.visible(self.drawn)
        if scripted is not None:
            return scripted == len(self.growth.rows)
        arrived, s = len(self.training_rows), self._settings
        if self._complete:
            return arrived > 0
        draws = (self.drawn + 1) * s.batch
        return arrived >= s.minimum_samples and draws <= s.replay_ratio * arrived + s.replay_buffer

    def draw_ahead(self, until: int) -> bool:
        """Draw and request batches, up to `prefetch` ahead and up to batch `until`; False if no batch is requested."""
        while self._restored:
            self._ask(self._restored.pop(0))
        while len(self._asked) < self._settings.prefetch and self.drawn < until:
            self.look()
            if not self.may_draw():
                break
            self._ask(self._sampler.draw(self._settings.batch))
            self.drawn += 1
        return bool(self._asked)

    def _ask(self, rows: tuple[int, ...]) -> None:
        self._asked.append(rows)
        self._group.send("rows", rows)
        self._feed.ask(self._group.part(rows))

    def take(self) -> TrainingBatch:
        """The next drawn batch, of which this process has read its part."""
        batch = self._feed.take()
        self._group.send("take")  # only now, so that other ranks do not wait for a rank whose reading failed
        self._asked.popleft()
        return batch

    def drop(self) -> None:
        """Drop this process's batches that were read ahead, so that other rows can be read; other ranks keep theirs."""
        for _ in self._asked:
            self._feed.take()

    def ask_again(self) -> None:
        """Request the dropped batches again."""
        for rows in self._asked:
            self._feed.ask(self._group.part(rows))

    def state(self) -> dict[str, Any]:
        """The state from which the same batches follow; int64 tensors for values of each row."""
        return {
            "sampler": self._sampler.state(),
            "asked": [list(rows) for rows in (*self._restored, *self._asked)],
            "drawn": self.drawn,
            "arrived": torch.tensor(self.growth.rows, dtype=torch.int64),
            "growth": torch.tensor(self.growth.log, dtype=torch.int64).reshape(-1, 2),
            "held_out": torch.tensor(self.held_out, dtype=torch.int64),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned."""
        self._sampler.restore(state["sampler"])
        self.drawn = state["drawn"]
        self.growth = Growth.of(state)
        self.held_out = state["held_out"].tolist()
        self._known = set(self.growth.rows)
        self._restored = [tuple(rows) for rows in state["asked"]]
