"""The choice of the next samples from a growing set: in rounds, with the least drawn ones more often."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from photonfarm.shared.core.keys import Stream, make_key


class RoundSampler:
    """Every round draws each row once, in random order, and a row that lags behind up to `catch_up` times more.

    Once no rows arrive, all are drawn equally often to within one. Uniform draws from a growing set would favour the
    early rows by r ln(n_end/n_then). Strictly the fewest-drawn first, shard by shard as they arrive, would train on the
    new shard's rows alone until they had caught up, and a network would forget the others; so here new rows come more
    often and never alone. A `catch_up` larger than the draws of any row gives that strict order. Deterministic in the
    seed, the order of arrival, and the number of rows that had arrived at each draw.
    """

    def __init__(self, seed: int, catch_up: int) -> None:
        self._seed, self._catch_up = seed, catch_up
        self.rows: list[int] = []
        self._visits = np.zeros(0, np.int64)
        self._joined = 0  # rows in the rounds; the others join at the next draw
        self._deck: deque[int] = deque()  # places in `rows`
        self._shuffles = 0

    @property
    def visits(self) -> dict[int, int]:
        """The number of draws of each row."""
        return dict(zip(self.rows, self._visits.tolist(), strict=True))

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

    def put_back(self, rows: Iterable[int]) -> None:
        """Undo draws of rows that could not be used: they lag behind by as many."""
        for row in rows:
            self._visits[self.rows.index(row)] -= 1

    def state(self) -> dict[str, Any]:
        """All that draws depend on besides the seed; int64 tensors for values of each row."""
        return {
            "rows": torch.tensor(self.rows, dtype=torch.int64),
            "visits": torch.from_numpy(self._visits.copy()),
            "joined": self._joined,
            "deck": torch.tensor(list(self._deck), dtype=torch.int64),
            "shuffles": self._shuffles,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`."""
        self.rows = state["rows"].tolist()
        self._visits = state["visits"].numpy().copy()
        self._joined = state["joined"]
        self._deck = deque(state["deck"].tolist())
        self._shuffles = state["shuffles"]

    def _round(self, first: int) -> NDArray[np.int64]:
        """A round of the places from `first` on: once each, and those that lag behind up to `catch_up` times more."""
        behind = self._visits.max(initial=0) - self._visits[first:]
        copies = 1 + np.minimum(behind, self._catch_up)
        return np.repeat(np.arange(first, len(self.rows)), copies)

    def _shuffle(self, places: NDArray[np.int64]) -> None:
        stream = Stream(make_key("rounds", self._seed, self._shuffles), "order")
        self._deck = deque(places[np.argsort(stream.uniform(len(places)), kind="stable")].tolist())
        self._shuffles += 1
