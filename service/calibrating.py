"""Takes a calibration of the map through the pool, a short step at a time between trainings."""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import dataclass, field

from gpom_core.link import Link
from gpom_core.mapper import CalibrationJob, Mapper


class CalibrationError(Exception):
    """A calibration was given up; probabilities stay as they are until the next is due.

    Attributes:
        pool_is_lost: workers died or hang; others are needed.
    """

    def __init__(self, why: str, *, pool_is_lost: bool = False) -> None:
        super().__init__(why)
        self.pool_is_lost = pool_is_lost


@dataclass(slots=True, eq=False)
class _Running:
    job: CalibrationJob
    steps: Iterator[Link | None]
    step: "Future[Link | None]" = field(default_factory=Future)
    started_s: float | None = None  # when a worker began the present step

    def run(self) -> Link | None:
        self.started_s = time.perf_counter()
        return next(self.steps)


class Calibrating:
    """At most one calibration at a time. Owned by the thread that owns the mapper.

    Args:
        mapper: says when one is due, and takes the result.
        timeout_s: a step that takes longer hangs.
        wake: called from any thread when a step is done.
    """

    def __init__(self, mapper: Mapper, *, timeout_s: float, wake: Callable[[], None]) -> None:
        self._mapper = mapper
        self._timeout_s = timeout_s
        self._wake = wake
        self._running: _Running | None = None
        self._wanted = False
        self._begun = self._ended = 0

    @property
    def active(self) -> bool:
        """Whether all probabilities may change a little, soon."""
        return self._running is not None or self._wanted

    def want(self) -> int:
        """Calibrate next, even if little is new.

        Returns:
            A number to ask `ended` about.
        """
        self._wanted = True
        return self._begun + 1

    def ended(self, number: int) -> bool:
        """Whether a calibration begun since `want` gave this number is over, well or not."""
        return self._ended >= number

    def begin(self, executor: Executor, *, if_due: bool = True) -> None:
        """Give the pool a calibration's first step, if one is wanted or (`if_due`) due.

        Raises:
            CalibrationError: the pool takes nothing.
        """
        if self._running is not None or not (self._wanted or if_due):
            return
        job = self._mapper.take_calibration(even_if_little_is_new=self._wanted)
        if job is not None or self._wanted:
            self._begun += 1
        self._wanted = False
        if job is None:
            self._ended = self._begun
        else:
            self._running = _Running(job, job.steps())
            self._submit(self._running, executor)

    def advance(self, executor: Executor) -> bool:
        """Take what the pool has done and give it the next step; tell whether it was the last.

        Raises:
            CalibrationError: the step failed or hangs, or the pool takes no other.
        """
        running = self._running
        if running is None or not running.step.done():
            self._look_at_the_clock()
            return False
        cancelled = running.step.cancelled()
        error = None if cancelled else running.step.exception()
        if error is not None:
            self._give_up()
            lost = isinstance(error, BrokenExecutor)
            raise CalibrationError(repr(error), pool_is_lost=lost) from error
        link = None if cancelled else running.step.result()
        if link is None:
            self._submit(running, executor)
            return False
        self._running, self._ended = None, self._begun
        self._mapper.calibrate(running.job, link)
        return True

    def _look_at_the_clock(self) -> None:
        running = self._running
        if running is None or running.started_s is None:
            return
        if time.perf_counter() - running.started_s > self._timeout_s:
            self._give_up()
            why = f"a step did not end within {self._timeout_s:g} s"
            raise CalibrationError(why, pool_is_lost=True)

    def _give_up(self) -> None:
        if self._running is not None:
            self._mapper.fail_calibration(self._running.job)
            self._running, self._ended = None, self._begun

    def _submit(self, running: _Running, executor: Executor) -> None:
        running.started_s = None
        try:
            running.step = executor.submit(running.run)
        except BrokenExecutor as error:
            self._give_up()
            raise CalibrationError(repr(error), pool_is_lost=True) from error
        running.step.add_done_callback(lambda _: self._wake())
