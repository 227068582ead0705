"""Somebody waits until all that was received is in the answers."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field


@dataclass(slots=True)
class Flush:
    """Somebody waits until scans up to `ticket` are in the answers.

    Once they are integrated, `missing` are the experts that were dirty at that moment, in `turn`
    of training. Each is done when a job taken later is swapped in, or when it is clean: so a flush
    ends even while new scans make experts dirty again all the time. Then, if it `calibrates`, the
    map is, by the `calibration` of that number: what a flush shows depends on the scans alone.
    """

    ticket: int
    calibrates: bool = True
    done: "Future[None]" = field(default_factory=Future)
    missing: set[int] | None = None
    turn: int = 0
    calibration: int | None = None

    def advance(self, settled_ticket: int, dirty: frozenset[int], turn: int) -> bool:
        """Look at what a step of training did not do; tell whether the wait is over."""
        if self.missing is None:
            if settled_ticket < self.ticket:
                return False
            self.missing, self.turn = set(dirty), turn
        self.missing &= dirty
        return not self.missing

    def follow(self, splits: Sequence[tuple[int, int]]) -> None:
        """Look at what was halved: the evidence of a missing expert is in both halves."""
        if self.missing is not None:
            for cluster, half in splits:
                if cluster in self.missing:
                    self.missing.add(half)

    def note(self, turns: Mapping[int, int]) -> None:
        """Look at what was swapped in."""
        if self.missing is not None:
            self.missing -= {cluster for cluster, turn in turns.items() if turn > self.turn}
