"""Chooses the next samples from a growing set, in rounds that draw the least drawn samples more often."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from photonfarm.core.keys import Stream, make_key


class RoundSampler:
    """Draws each row once a round, in random order, and a row that was drawn less often up to `catch_up` times more.

    Some time after the last arrival all rows have been drawn equally often, to within one. Two simpler ways are worse.
    Uniform draws from a growing set would favour early rows, by r ln(n_end/n_then). Drawing the least drawn rows first
    would train on each new shard alone until it had caught up, and the network would forget the others. Here new rows
    come more often, but never alone; only a `catch_up` above the draws of every row gives that strict order.

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
