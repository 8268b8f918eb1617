"""The stream of training batches from a growing store, at a pace limited by its growth.

Samples are drawn in rounds, which choose the least drawn ones more often.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from photonfarm.core.errors import SpecError
from photonfarm.core.keys import Stream, make_key
from photonfarm.trainer.data.batch import TrainingBatch
from photonfarm.trainer.data.feed import Feed
from photonfarm.trainer.networks import find_kind
from photonfarm.trainer.runs.devices import Ranks
from photonfarm.trainer.runs.settings import TrainSettings


class RoundSampler:
    """Draws each row once a round, in random order, and a row that was drawn less often up to `catch_up` times more.

    Some time after the last arrival all rows have been drawn equally often, to within one. Two simpler ways are worse.
    Uniform draws from a growing set would favour early rows: with r draws for each arrival, row n of n_end would be
    drawn r·ln(n_end/n) times. Drawing the least drawn rows first would train on each new shard alone until it had
    caught up, and the network would forget the others. Here new rows come more often, but never alone; only a
    `catch_up` above the draws of every row gives that strict order.

    Draws depend on the seed, the order of arrival, and the number of rows that had arrived at each draw, and on nothing
    else.
    """

    def __init__(self, seed: int, catch_up: int) -> None:
        self._seed, self._catch_up = seed, catch_up
        self.rows: list[int] = []
        self._visits = np.zeros(0, np.int64)
        self._joined = 0  # number of rows that take part in rounds; the others join at the next draw
        self._deck: deque[int] = deque()  # places in `rows`
        self._shuffles = 0

    def add(self, rows: Iterable[int]) -> None:
        """Add rows that have arrived; they join the current round at the next draw."""
        self.rows.extend(rows)
        self._visits = np.pad(self._visits, (0, len(self.rows) - len(self._visits)))

    def draw(self, count: int) -> tuple[int, ...]:
        """Draw the next `count` rows; all are different if there are enough."""
        if not self.rows:
            raise ValueError("no row has arrived; nothing can be drawn")
        if self._joined < len(self.rows):
            self._shuffle(np.concatenate([np.array(self._deck, np.int64), self._round(self._joined)]))
            self._joined = len(self.rows)
        chosen: list[int] = []
        passed: list[int] = []  # drawn again too soon; back to the front of the deck
        while len(chosen) < count:
            if not self._deck:
                self._shuffle(self._round(0))
            place = self._deck.popleft()
            if place in chosen and len(chosen) < len(self.rows):
                passed.append(place)
            else:
                chosen.append(place)
                self._visits[place] += 1
        self._deck.extendleft(reversed(passed))
        return tuple(self.rows[place] for place in chosen)

    def state(self) -> dict[str, Any]:
        """The state that later draws depend on, besides the seed; values of each row are int64 tensors."""
        return {
            "rows": torch.tensor(self.rows, dtype=torch.int64),
            "visits": torch.from_numpy(self._visits.copy()),
            "joined": self._joined,
            "deck": torch.tensor(list(self._deck), dtype=torch.int64),
            "shuffles": self._shuffles,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned."""
        self.rows = state["rows"].tolist()
        self._visits = state["visits"].numpy().copy()
        self._joined = state["joined"]
        self._deck = deque(state["deck"].tolist())
        self._shuffles = state["shuffles"]

    def _round(self, first: int) -> NDArray[np.int64]:
        """A round of the places from `first` on: each once, and those drawn less often up to `catch_up` times more."""
        behind = self._visits.max(initial=0) - self._visits[first:]
        copies = 1 + np.minimum(behind, self._catch_up)
        return np.repeat(np.arange(first, len(self.rows)), copies)

    def _shuffle(self, places: NDArray[np.int64]) -> None:
        stream = Stream(make_key("rounds", self._seed, self._shuffles), "order")
        self._deck = deque(places[np.argsort(stream.uniform(len(places)), kind="stable")].tolist())
        self._shuffles += 1


class BatchStream:
    """Draws batches, and has them read, ahead of training.

    The rows that arrived, and when, determine the order of training together with the seed. A run's checkpoint has all
    of it, as `following.arrived` and `following.growth`.
    """

    def __init__(self, feed: Feed, settings: TrainSettings, ranks: Ranks) -> None:
        """Draw batches for all ranks, and read this process's part of them."""
        self._feed, self._settings, self._ranks = feed, settings, ranks
        self._sampler = RoundSampler(settings.seed, settings.catch_up)
        self._known: set[int] = set()
        self._skipped: set[int] = set()  # of the training rows that were drawn so far
        self._asked: deque[tuple[int, ...]] = deque()  # drawn, not yet trained on
        self._restored: list[tuple[int, ...]] = []  # the same of an earlier session, not requested in this one yet
        self._rounds = settings.rounds if find_kind(settings.network.architecture).needs.passes else math.inf
        self.complete = False  # everything planned has arrived
        self.last_step: int | None = None  # at which all rounds are over; None while more is to come, or without end
        self.arrived: list[int] = []  # rows, in order of arrival
        self.growth: list[tuple[int, int]] = []  # (batches drawn by then, rows that had arrived)
        self.held_out: list[int] = []
        self.drawn = 0  # batches

    @property
    def training_rows(self) -> list[int]:
        """The rows that have arrived and are to train on, in order of arrival."""
        return self._sampler.rows

    def look(self) -> None:
        """Take in the rows that have arrived."""
        arrived, self.complete = self._feed.arrivals()
        if new := {row: side for row, side in arrived if row not in self._known}:
            self._known.update(new)
            self.arrived.extend(new)
            self.growth.append((self.drawn, len(self.arrived)))
            self.held_out.extend(row for row, side in new.items() if side == "held-out")
            self._sampler.add(row for row, side in new.items() if side == "train")
        ends = self.complete and self._rounds < math.inf
        last_step = int(self._rounds * self._count_left()) // self._settings.batch if ends else None
        if last_step != self.last_step:
            self.last_step = last_step
            self._ranks.send("last", last_step)

    def check_split(self) -> None:
        """Raise SpecError, which names a share that would do, if all samples planned are on one side."""
        if self.held_out and self.training_rows:
            return
        one = "configuration" if self._feed.spec.groups else "view"
        fault = "all are held out, and none is left to train on"
        if not self.held_out:
            fault = "none is held out, and one is needed to validate on"
        other = self._feed.other_hold_out()
        remedy = f"plan more {one}s" if other is None else f"hold_out = {other:g} holds out one {one} of these"
        raise SpecError(
            f"hold_out = {self._settings.hold_out:g}: of the {len(self.arrived)} samples planned {fault}; {remedy}"
        )

    def _count_left(self) -> int:
        """The training rows without those that are known to be skipped, as all are once each has been drawn."""
        return len(self.training_rows) - len(self._skipped)

    def may_draw(self) -> bool:
        """Whether another batch may be drawn: draws ≤ R × arrived + buffer, and `minimum_samples` have arrived.

        Once everything planned has arrived, there is no limit but that of `rounds`, where a network has one.
        """
        arrived, s = self._count_left(), self._settings
        draws = (self.drawn + 1) * s.batch
        if self.complete:
            return arrived > 0 and draws <= self._rounds * arrived
        is_enough = len(self.training_rows) >= s.minimum_samples
        return is_enough and draws <= min(s.replay_ratio, self._rounds) * arrived + s.replay_buffer

    def draw_ahead(self, until: int) -> bool:
        """Draw and request batches, up to `prefetch` ahead and up to batch `until`; False if no batch is requested."""
        while self._restored:
            self._ask(self._restored.pop(0))
        while len(self._asked) < self._settings.prefetch and self.drawn < until:
            self.look()
            if not self.may_draw():
                break
            if not (rows := self._draw()):
                break
            self._ask(rows)
            self.drawn += 1
        return bool(self._asked)

    def _draw(self) -> tuple[int, ...]:
        """The rows of the next batch; skipped ones are drawn and passed over.

        No rows if all that have arrived are skipped; SpecError once everything has arrived.
        """
        rows: list[int] = []
        size, rounds = self._settings.batch, 2 + self._settings.catch_up
        for _ in range(size * rounds * len(self.training_rows)):  # by then each row has come so many times
            drawn = self._sampler.draw(size - len(rows))
            self._skipped.update(filter(self._feed.is_skipped, drawn))
            rows += (row for row in drawn if row not in self._skipped)
            if len(rows) == size:
                return tuple(rows)
        if not self.complete:
            return ()
        skipped = ", ".join(self._settings.skip_views)
        raise SpecError(f"skip_views: without views that are {skipped}, none of those planned is left")

    def _ask(self, rows: tuple[int, ...]) -> None:
        self._asked.append(rows)
        self._ranks.send("rows", rows)
        self._feed.ask(self._ranks.part(rows))

    def take(self) -> TrainingBatch:
        """The next drawn batch, of which this process has read its part."""
        batch = self._feed.take()
        self._ranks.send("take")  # only now, so that other ranks do not wait for a rank whose reading failed
        self._asked.popleft()
        return batch

    def drop(self) -> None:
        """Drop this process's batches that were read ahead, so that it can read others to validate; then `ask_again`.

        Other ranks keep theirs.
        """
        for _ in self._asked:
            self._feed.take()

    def ask_again(self) -> None:
        """Request the dropped batches again."""
        for rows in self._asked:
            self._feed.ask(self._ranks.part(rows))

    def state(self) -> dict[str, Any]:
        """The state from which the same batches follow; int64 tensors for values of each row."""
        return {
            "sampler": self._sampler.state(),
            "asked": [list(rows) for rows in (*self._restored, *self._asked)],
            "drawn": self.drawn,
            "arrived": torch.tensor(self.arrived, dtype=torch.int64),
            "growth": torch.tensor(self.growth, dtype=torch.int64).reshape(-1, 2),
            "held_out": torch.tensor(self.held_out, dtype=torch.int64),
            "skipped": torch.tensor(sorted(self._skipped), dtype=torch.int64),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from what `state` returned; then `look`, as more may be planned by now."""
        self._sampler.restore(state["sampler"])
        self.drawn = state["drawn"]
        self.arrived = state["arrived"].tolist()
        self.growth = [(drawn, arrived) for drawn, arrived in state["growth"].tolist()]
        self.held_out = state["held_out"].tolist()
        self._known, self._skipped = set(self.arrived), set(state.get("skipped", torch.zeros(0)).tolist())
        self._restored = [tuple(rows) for rows in state["asked"]]
