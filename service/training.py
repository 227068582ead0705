"""Keeps experts up to date: takes jobs from the mapper, runs them in a pool, swaps results in."""

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import dataclass
from functools import partial

from gpom_core.mapper import Mapper, TrainedExpert, TrainingJob
from gpom_core.snapshot import Snapshot
from service.calibrating import Calibrating, CalibrationError
from service.clock import Clock
from service.metrics import Metrics

logger = logging.getLogger(__name__)

_CHUNK_S = 0.01  # of work given to a worker at once: handing over costs about 0.1 ms
_AHEAD = 1.5  # work in the pool lasts this many swap intervals, so that no worker runs dry
_JOBS_MAX_PER_WORKER = 256
_SMOOTHING = 0.2  # weight of the newest chunk in the running mean of a job's duration


@dataclass(frozen=True, slots=True)
class Quarantine:
    """An expert that was set aside: it failed again and again, even on newer evidence."""

    cluster_id: int
    revision: int
    error: str


@dataclass(frozen=True, slots=True)
class Swap:
    """A new version of the map, and for each expert swapped in the turn its job was taken."""

    snapshot: Snapshot
    turns: Mapping[int, int]


@dataclass(slots=True, eq=False)
class _Chunk:
    """Jobs that one worker does after another; `started_s` is when it began the one at `at`."""

    jobs: Sequence[TrainingJob]
    at: int = 0
    started_s: float | None = None
    abandoned: bool = False

    def __len__(self) -> int:
        return len(self.jobs)


@dataclass(frozen=True, slots=True)
class _Outcome:
    job: TrainingJob
    trained: TrainedExpert | None
    error: str
    seconds: float


class Training:
    """The training loop, one step at a time. Owned by the thread that owns the mapper.

    Args:
        mapper: gives jobs, most useful first, and takes results.
        executor: runs jobs; they are pure, so any executor will do.
        workers: how many jobs the executor runs at once.
        swap_interval_s: under load results are collected this long before they are swapped in.
        attempts_max: an expert that failed this often in a row is set aside.
        job_timeout_s: a job that takes longer hangs: it failed, and its worker is written off.
        renew: gives another executor when workers of this one died or hang.
        wake: called from any thread when jobs are done, so that the owner makes a step.
    """

    def __init__(  # noqa: PLR0913 - all but the first two by keyword
        self,
        mapper: Mapper,
        executor: Executor,
        *,
        workers: int,
        swap_interval_s: float,
        attempts_max: int,
        job_timeout_s: float = 60.0,
        renew: Callable[[], Executor] | None = None,
        metrics: Metrics,
        clock: Clock,
        wake: Callable[[], None],
    ) -> None:
        self._mapper = mapper
        self._executor = executor
        self._workers = workers
        self._own = executor, workers
        self._swap_interval_s = swap_interval_s
        self._attempts_max = attempts_max
        self._metrics = metrics
        self._clock = clock
        self._wake = wake
        self._job_timeout_s = job_timeout_s
        self._renew = renew
        self._chunks: set[_Chunk] = set()
        # Filled by the pool, emptied by the owner.
        self._finished: deque[tuple[_Chunk, list[_Outcome] | None]] = deque()
        self._turn = 0
        self._in_pool: dict[int, int] = {}  # cluster -> turn
        self._trained: list[TrainedExpert] = []
        self._turns: dict[int, int] = {}  # of what was trained
        self._failures: dict[int, int] = {}  # cluster -> attempts in a row
        self._quarantined: dict[int, Quarantine] = {}
        self._calibrating = Calibrating(mapper, timeout_s=job_timeout_s, wake=wake)
        self._last_swap_s = clock.monotonic_s()
        self._job_s = 0.01
        self._version = mapper.snapshot().version
        self._borrowed = False

    @property
    def turn(self) -> int:
        """The number of the last step: jobs taken later have a larger one."""
        return self._turn

    @property
    def idle(self) -> bool:
        """Whether nothing is being trained or waits to be swapped in."""
        return not (self._in_pool or self._trained or self._calibrating.active)

    def borrow(self, helpers: Executor, workers: int) -> None:
        """Let others run jobs until `give_back`, so many at once; calibrate when asked to only."""
        self._executor, self._workers = helpers, workers
        self._borrowed = True

    def give_back(self) -> None:
        """Let the executor run jobs again that is there for it."""
        self._executor, self._workers = self._own
        self._borrowed = False
        self._wake()  # a calibration may be due

    def calibrate(self) -> int:
        """Calibrate next, even if little is new; give a number to ask `calibrated` about."""
        self._wake()
        return self._calibrating.want()

    def calibrated(self, number: int) -> bool:
        """Whether a calibration begun since `calibrate` gave this number is over."""
        return self._calibrating.ended(number)

    def quarantined(self) -> tuple[Quarantine, ...]:
        """The experts that are set aside."""
        return tuple(self._quarantined.values())

    def step(self) -> Swap | None:
        """Collect results, swap them in if it is time, give the pool new jobs.

        Returns:
            What is new in the map, if anything.
        """
        self._turn += 1
        self._collect()
        self._give_up_hanging()
        self._top_up()
        if self._calibrate():
            self._wake()  # each version tells what changed since the one before: no swap as well
            return self._news({})
        if self._in_pool and self.seconds_to_swap() != 0.0:
            return None
        swap = self._swap()
        self._begin_calibration()
        self._top_up()  # experts that changed while they were trained can be taken only now
        return swap

    def seconds_to_swap(self) -> float | None:
        """How long results may still wait for company; None when there are none."""
        if not self._trained:
            return None
        return max(0.0, self._last_swap_s + self._swap_interval_s - self._clock.monotonic_s())

    def seconds_to_look(self) -> float | None:
        """When `step` should look for hanging jobs again; None while there are none."""
        busy = self._chunks or self._calibrating.active
        return min(1.0, self._job_timeout_s) if busy else None

    def _swap(self) -> Swap | None:
        trained, self._trained = self._trained, []
        turns, self._turns = self._turns, {}
        with self._metrics.swap_seconds.time():
            # Without results too: experts that lost all their evidence leave the map here.
            self._mapper.swap(trained)
        if trained:
            self._last_swap_s = self._clock.monotonic_s()
        return self._news(turns)

    def _news(self, turns: Mapping[int, int]) -> Swap | None:
        snapshot = self._mapper.snapshot()
        if snapshot.version == self._version and not turns:
            return None
        self._version = snapshot.version
        return Swap(snapshot, turns)

    def _begin_calibration(self) -> None:
        try:
            self._calibrating.begin(self._executor, if_due=not self._borrowed)
        except CalibrationError as error:
            self._uncalibrated(error)

    def _calibrate(self) -> bool:
        """Go on with the calibration under way; tell whether the map has a new one."""
        try:
            return self._calibrating.advance(self._executor)
        except CalibrationError as error:
            self._uncalibrated(error)
            return False

    def _uncalibrated(self, error: CalibrationError) -> None:
        self._metrics.training_failures.inc()
        logger.error("probabilities are those of an older calibration", exc_info=error)
        if error.pool_is_lost:
            self._renew_executor()

    def _top_up(self) -> None:
        room = self._capacity() - len(self._in_pool)
        if room <= 0:
            return
        jobs = self._mapper.take_jobs(room)
        self._in_pool |= dict.fromkeys((job.cluster_id for job in jobs), self._turn)
        size = max(1, min(int(_CHUNK_S / self._job_s), -(-len(jobs) // self._workers)))
        for start in range(0, len(jobs), size):
            self._submit(_Chunk(jobs[start : start + size]))

    def _submit(self, chunk: _Chunk) -> None:
        self._chunks.add(chunk)
        try:
            future = self._executor.submit(_run_all, chunk)
        except BrokenExecutor as error:
            self._renew_executor()
            self._finished.append((chunk, _all_failed(chunk.jobs, error)))
            self._wake()
        else:
            future.add_done_callback(partial(self._finish, chunk))

    def _renew_executor(self) -> None:
        if self._renew is not None:
            logger.warning("workers died or hang; new ones take over")
            self._executor = self._renew()
            self._own = self._executor, self._own[1]

    def _give_up_hanging(self) -> None:
        """Take jobs from workers that have not ended one in time; it fails, the others go on."""
        now_s = time.perf_counter()
        hanging = [
            chunk
            for chunk in self._chunks
            if chunk.started_s is not None and now_s - chunk.started_s > self._job_timeout_s
        ]
        for chunk in hanging:
            chunk.abandoned = True
            self._chunks.discard(chunk)
            stuck = chunk.jobs[chunk.at]
            for job in chunk.jobs:
                self._in_pool.pop(job.cluster_id)
                if job is stuck:
                    self._failed(job, f"did not end within {self._job_timeout_s:g} s")
                else:
                    self._mapper.fail(job)  # what it did before is lost with it
        if hanging:
            self._renew_executor()

    def _capacity(self) -> int:
        """Jobs that keep the pool busy for a little longer than until the next swap."""
        per_worker = int(_AHEAD * self._swap_interval_s / self._job_s)
        return max(1, min(per_worker, _JOBS_MAX_PER_WORKER)) * self._workers

    def _finish(self, chunk: _Chunk, future: "Future[list[_Outcome]]") -> None:
        # Runs in a thread of the pool. Cancelled: it waited behind a worker that was written off.
        if future.cancelled():
            self._finished.append((chunk, None))
        elif (error := future.exception()) is not None:  # the worker died
            self._finished.append((chunk, _all_failed(chunk.jobs, error)))
        else:
            self._finished.append((chunk, future.result()))
        self._wake()

    def _collect(self) -> None:
        while self._finished:
            chunk, outcomes = self._finished.popleft()
            if chunk.abandoned:
                continue
            self._chunks.discard(chunk)
            if outcomes is None:
                for job in chunk.jobs:
                    self._in_pool.pop(job.cluster_id)
                    self._mapper.fail(job)
                continue
            for outcome in outcomes:
                turn = self._in_pool.pop(outcome.job.cluster_id)
                if outcome.trained is None:
                    self._failed(outcome.job, outcome.error)
                else:
                    self._succeeded(outcome.trained, turn)
                    self._metrics.train_seconds.observe(outcome.seconds)
            mean_s = sum(outcome.seconds for outcome in outcomes) / len(outcomes)
            self._job_s += _SMOOTHING * (mean_s - self._job_s)

    def _succeeded(self, trained: TrainedExpert, turn: int) -> None:
        self._trained.append(trained)
        self._turns[trained.cluster_id] = turn
        self._failures.pop(trained.cluster_id, None)
        self._quarantined.pop(trained.cluster_id, None)

    def _failed(self, job: TrainingJob, error: str) -> None:
        self._metrics.training_failures.inc()
        attempts = self._failures.get(job.cluster_id, 0) + 1
        self._failures[job.cluster_id] = attempts
        if attempts < self._attempts_max:
            self._mapper.fail(job)
            return
        if job.cluster_id not in self._quarantined:
            logger.error(
                "expert %d is set aside: training failed %d times: %s",
                job.cluster_id,
                attempts,
                error,
            )
        self._quarantined[job.cluster_id] = Quarantine(job.cluster_id, job.revision, error)
        self._mapper.set_aside(job)


def _run_all(chunk: _Chunk) -> list[_Outcome]:
    outcomes = []
    for place, job in enumerate(chunk.jobs):
        chunk.at, chunk.started_s = place, time.perf_counter()
        outcomes.append(_run(job))
    return outcomes


def _all_failed(jobs: Sequence[TrainingJob], error: BaseException) -> list[_Outcome]:
    return [_Outcome(job, None, repr(error), 0.0) for job in jobs]


def _run(job: TrainingJob) -> _Outcome:
    start_s = time.perf_counter()
    try:
        trained = job.run()
    except Exception as error:
        logger.warning("training of expert %d failed", job.cluster_id, exc_info=True)
        return _Outcome(job, None, repr(error), time.perf_counter() - start_s)
    return _Outcome(job, trained, "", time.perf_counter() - start_s)
