"""The one thread that owns the map: integrates scans, keeps experts trained, swaps them in.

Scans never wait for training: jobs run in a pool, and this thread only hands them out and
collects them between two slices of integration.
"""

import logging
import threading
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field

from gpom_core.config import MapConfig
from gpom_core.errors import InvalidScanError
from gpom_core.mapper import Mapper
from gpom_core.snapshot import Snapshot
from service.clock import Clock
from service.errors import StoppingError
from service.events import EventBus, MapChanged
from service.ingest import Batch
from service.journal import ScanRecord
from service.metrics import Metrics
from service.settings import IngestSettings, TrainingSettings
from service.training import Quarantine, Training
from service.warmup import warm_up
from service.worker import Worker

logger = logging.getLogger(__name__)

_SLICE_S = 0.03  # longest stretch of integration before training gets its turn


@dataclass(frozen=True, slots=True)
class MapState:
    """The map at one moment; replaced as a whole, so readers need no lock.

    Attributes:
        snapshot: what queries are answered from.
        scans_integrated: scans whose evidence is in the map, trained or not.
        experts: those that exist, trained or not.
        dirty: clusters whose newest evidence is not in `snapshot`.
        observations: of all experts.
        quarantined: experts that cannot be trained.
    """

    snapshot: Snapshot
    scans_integrated: int = 0
    experts: int = 0
    dirty: frozenset[int] = frozenset()
    observations: int = 0
    quarantined: tuple[Quarantine, ...] = ()


@dataclass(slots=True)
class _Flush:
    """Somebody waits until scans up to `ticket` are in the answers.

    Once they are integrated, `missing` are the experts that were dirty at that moment, in `turn`
    of training. Each is done when a job taken later is swapped in, or when it is clean: so a flush
    ends even while new scans make experts dirty again all the time.
    """

    ticket: int
    done: "Future[None]" = field(default_factory=Future)
    missing: set[int] | None = None
    turn: int = 0

    def advance(self, settled_ticket: int, dirty: frozenset[int], turn: int) -> bool:
        """Look at what a step of training did not do; tell whether the wait is over."""
        if self.missing is None:
            if settled_ticket < self.ticket:
                return False
            self.missing, self.turn = set(dirty), turn
        self.missing &= dirty
        return not self.missing

    def note(self, turns: Mapping[int, int]) -> None:
        """Look at what was swapped in."""
        if self.missing is not None:
            self.missing -= {cluster for cluster, turn in turns.items() if turn > self.turn}


class MapKeeper:
    """Owns the mapper. Everything but `_step` may be called from any thread."""

    def __init__(
        self,
        mapper: Mapper,
        executor: Executor,
        config: MapConfig,
        *,
        ingest: IngestSettings,
        training: TrainingSettings,
        events: EventBus,
        metrics: Metrics,
        clock: Clock,
    ) -> None:
        self._mapper = mapper
        self._config = config
        self._events = events
        self._metrics = metrics
        self._clock = clock
        self._backlog_scans_max = ingest.backlog_scans_max
        self._changed = threading.Condition()
        self._batches: deque[Batch] = deque()
        self._backlog = 0
        self._flushes: list[_Flush] = []
        self._stopping = False
        self._poked = False
        self._warm = False
        self._current: deque[ScanRecord] = deque()
        self._current_ticket = 0
        self._settled_ticket = 0
        self._integrated = 0
        self._training = Training(
            mapper,
            executor,
            workers=training.workers,
            swap_interval_s=training.swap_interval_s,
            attempts_max=training.attempts_max,
            metrics=metrics,
            clock=clock,
            wake=self._poke,
        )
        self.worker = Worker(
            "mapping", self._step, lambda name: metrics.loop_errors.labels(name).inc()
        )
        self.state = MapState(mapper.snapshot())

    @property
    def backlog(self) -> int:
        """Stored scans that are not integrated yet."""
        return self._backlog

    def trouble(self) -> str | None:
        """Why the map is not kept up to date; None when it is."""
        if not self._warm and self.worker.trouble() is None:
            return "the numerical kernels are being compiled"
        return self.worker.trouble()

    def offer(self, batch: Batch) -> None:
        """Hand over stored scans; blocks while too many wait, and drops them when stopping."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._stopping or self._backlog < self._backlog_scans_max
            )
            if self._stopping:
                return
            self._batches.append(batch)
            self._backlog += len(batch.records)
            self._changed.notify_all()

    def flush(self, ticket: int) -> "Future[None]":
        """Give a future that is done once all scans up to `ticket` are in the answers.

        Cancel it to give up. It fails with StoppingError when the service stops first.
        """
        flush = _Flush(ticket)
        with self._changed:
            if self._stopping:
                flush.done.set_exception(StoppingError("the service is shutting down"))
            else:
                self._flushes.append(flush)
                self._poked = True
                self._changed.notify_all()
        return flush.done

    def stop(self) -> None:
        """Let the thread end after the step it is in; what waits is not integrated."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._give_up_flushes()

    def _give_up_flushes(self) -> None:
        with self._changed:
            flushes, self._flushes = self._flushes, []
        for flush in flushes:
            if flush.done.set_running_or_notify_cancel():
                flush.done.set_exception(StoppingError("the service is shutting down"))

    def _step(self) -> bool:
        if not self._warm:
            warm_up(self._config)
            self._warm = True
        if not self._wait():
            self._give_up_flushes()
            return False
        self._integrate()
        swap = self._training.step()
        self._publish()
        if swap is not None:
            news = MapChanged(swap.snapshot.version, swap.snapshot.changed_bounds)
            self._events.publish(news)
        self._settle({} if swap is None else swap.turns)
        return True

    def _wait(self) -> bool:
        """Wait for something to do, and take it; False when it is time to end."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._stopping or self._poked or bool(self._current or self._batches),
                timeout=self._training.seconds_to_swap(),
            )
            self._poked = False
            if not self._current and self._batches:
                batch = self._batches.popleft()
                self._current.extend(batch.records)
                self._current_ticket = batch.ticket
            return not self._stopping

    def _poke(self) -> None:
        with self._changed:
            self._poked = True
            self._changed.notify_all()

    def _integrate(self) -> None:
        done = 0
        end_s = self._clock.monotonic_s() + _SLICE_S
        while self._current and (done == 0 or self._clock.monotonic_s() < end_s):
            record = self._current.popleft()
            done += 1
            self._integrate_one(record)
        if not self._current:
            self._settled_ticket = self._current_ticket
        if done:
            with self._changed:
                self._backlog -= done
                self._changed.notify_all()

    def _integrate_one(self, record: ScanRecord) -> None:
        try:
            with self._metrics.update_seconds.time():
                report = self._mapper.update(record.scan)
        except InvalidScanError as error:
            self._metrics.scans_refused.labels(error.reason).inc()
            logger.debug("scan of %s not integrated: %s", record.robot, error)
        except Exception:
            self._metrics.scans_refused.labels("internal_error").inc()
            logger.exception("scan %d of %s broke the mapper", record.scan.seq, record.robot)
        else:
            self._integrated += 1
            self._metrics.observations_new.inc(report.new_observations)

    def _publish(self) -> None:
        self.state = MapState(
            snapshot=self._mapper.snapshot(),
            scans_integrated=self._integrated,
            experts=self._mapper.expert_count,
            dirty=self._mapper.dirty_ids(),
            observations=self._mapper.observation_count,
            quarantined=self._training.quarantined(),
        )

    def _settle(self, turns: Mapping[int, int]) -> None:
        with self._changed:
            flushes, self._flushes = self._flushes, []
        waiting = []
        for flush in flushes:
            flush.note(turns)
            if flush.advance(self._settled_ticket, self.state.dirty, self._training.turn):
                if flush.done.set_running_or_notify_cancel():
                    flush.done.set_result(None)
            elif not flush.done.cancelled():
                waiting.append(flush)
        with self._changed:
            self._flushes += waiting
