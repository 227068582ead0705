"""Saves the map now and then, beside the thread that owns it."""

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from gpom_core.image import dump
from gpom_core.link import Link
from gpom_core.mapper import Mapper
from service.clock import Clock
from service.errors import MapFileError
from service.metrics import Metrics

logger = logging.getLogger(__name__)

_REST_S = 2.0  # robots that sent nothing for so long have come to rest
_SOONEST = 1 / 6  # of the interval, between two copies because of that
_LOOK_S = 0.1  # how often it is looked whether the last copy is written

Save = Callable[[Mapping[str, NDArray[np.generic]], int], None]
"""Keeps an image of the map that goes up to a position in the journal."""

KeepLink = Callable[[Link, int], None]
"""Keeps what the map was calibrated to at a position, between two images."""


class Saver:
    """Copies the map in the thread that owns it, and writes the copy in another.

    Args:
        save: writes; raises MapFileError.
        position: up to which the map is saved already.
        interval_s: between two copies, also if one cannot be written. When robots have come to rest
            there is one sooner: a restart has nothing to integrate then.
        keep_link: writes a few bytes, after each calibration; never raises.
    """

    def __init__(
        self,
        save: Save,
        position: int,
        *,
        interval_s: float,
        metrics: Metrics,
        clock: Clock,
        keep_link: KeepLink | None = None,
    ) -> None:
        self._save = save
        self._keep_link = keep_link
        self._link = Link()  # of who was never calibrated: not worth keeping
        self._interval_s = interval_s
        self._metrics = metrics
        self._clock = clock
        self._saved = (position, -1)
        self._offered = position
        self._next_s = clock.monotonic_s() + interval_s
        self._heard_s = clock.monotonic_s()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="gpom-save")
        self._running: Future[None] | None = None
        self._trouble: str | None = None

    def trouble(self) -> str | None:
        """Why the last copy could not be written; None if it was."""
        return self._trouble

    def seconds_to_save(self) -> float | None:
        """When the next offer is wanted; None if nothing changed since the last."""
        if self._offered == self._saved[0]:
            return None
        soonest_s = self._next_s - (1.0 - _SOONEST) * self._interval_s
        due_s = min(self._next_s, max(soonest_s, self._heard_s + _REST_S))
        return max(_LOOK_S if self._writing else 0.0, due_s - self._clock.monotonic_s())

    @property
    def _writing(self) -> bool:
        return self._running is not None and not self._running.done()

    def hurry(self) -> None:
        """Want the next offer now: what was just restored need not be integrated once more."""
        self._next_s = self._clock.monotonic_s()

    def offer(self, mapper: Mapper, position: int) -> None:
        """Copy the map if it is time. Called by the thread that owns it."""
        if position != self._offered:
            self._offered, self._heard_s = position, self._clock.monotonic_s()
        link = mapper.snapshot().link
        if self._keep_link is not None and link != self._link:
            self._link = link
            self._pool.submit(self._keep_link, link, position)
        if self.seconds_to_save() != 0.0:
            return
        self._next_s = self._clock.monotonic_s() + self._interval_s
        state, image = _state(mapper, position), dump(mapper)
        self._running = self._pool.submit(self._write, image, state)

    def save_now(self, mapper: Mapper, position: int) -> None:
        """Write the map, unless it is saved as it is. The owner's thread must have ended."""
        self._pool.shutdown(wait=True)
        state = _state(mapper, position)
        if state != self._saved:
            self._write(dump(mapper), state)

    def close(self) -> None:
        """Start no more writing."""
        self._pool.shutdown(wait=False)

    def _write(self, image: Mapping[str, NDArray[np.generic]], state: tuple[int, int]) -> None:
        try:
            with self._metrics.checkpoint_seconds.time():
                self._save(image, state[0])
        except MapFileError as error:
            self._metrics.checkpoint_failures.inc()
            self._trouble = f"the map cannot be saved: {error}"
            logger.error("%s", self._trouble)  # noqa: TRY400 - the message says it all
        except Exception:
            self._metrics.checkpoint_failures.inc()
            self._trouble = "the map cannot be saved; the log of the service has the cause"
            logger.exception("saving the map failed")
        else:
            self._trouble = None
            self._saved = state


def _state(mapper: Mapper, position: int) -> tuple[int, int]:
    return position, mapper.snapshot().version
