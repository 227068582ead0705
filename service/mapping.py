"""The one thread that owns the map: integrates scans, keeps experts trained, swaps them in.

Scans never wait for training: jobs run in a pool, and this thread only hands them out and
collects them between two slices of integration.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

from gpom_core.config import MapConfig
from gpom_core.errors import InvalidScanError
from gpom_core.link import Link
from gpom_core.mapper import Mapper
from gpom_core.snapshot import Snapshot
from service.clock import Clock
from service.errors import StoppingError
from service.events import EventBus, MapChanged
from service.fleet import Fleet
from service.flush import Flush
from service.ingest import Batch
from service.journal import ScanRecord, StoredScan
from service.metrics import Metrics
from service.saver import Saver
from service.settings import IngestSettings, TrainingSettings
from service.tail import Tail
from service.training import Quarantine, Training
from service.warmup import warm_up
from service.worker import Worker

logger = logging.getLogger(__name__)

_TAIL_SCANS = 256
_SLICE_S = 0.03  # longest stretch of integration before training gets its turn
_LONG_SLICE_S = 0.2  # with a backlog: experts trained less often cost less, and nobody waits longer
_BACKLOG_SCANS = 20


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


class MapKeeper:
    """Owns the mapper. Everything but `_step` may be called from any thread."""

    def __init__(  # noqa: PLR0913 - all but the first three by keyword
        self,
        mapper: Mapper,
        executor: Executor,
        config: MapConfig,
        *,
        ingest: IngestSettings,
        training: TrainingSettings,
        events: EventBus,
        fleet: Fleet,
        metrics: Metrics,
        clock: Clock,
        renew_executor: Callable[[], Executor] | None = None,
    ) -> None:
        self._config = config
        self._events = events
        self._fleet = fleet
        self._metrics = metrics
        self._clock = clock
        self._beams_max = ingest.beams_max
        self._backlog_scans_max = ingest.backlog_scans_max
        self._changed = threading.Condition()
        self._batches: deque[Batch] = deque()
        self._backlog = 0
        self._flushes: list[Flush] = []
        self._stopping = False
        self._begun = False
        self._poked = False
        self._warm = False
        self._current: deque[ScanRecord] = deque()
        self._current_ticket = 0
        self._settled_ticket = 0
        self._position = 0  # in the journal, of the last scan that was handed over
        self._tail: Tail | None = None
        self._restored: Future[None] | None = None
        self._helpers: ThreadPoolExecutor | None = None
        self._saver: Saver | None = None
        self._new_training = partial(
            Training,
            executor=executor,
            workers=training.workers,
            swap_interval_s=training.swap_interval_s,
            attempts_max=training.attempts_max,
            job_timeout_s=training.job_timeout_s,
            renew=renew_executor,
            metrics=metrics,
            clock=clock,
            wake=self._poke,
        )
        self._adopt(mapper)
        self.worker = Worker(
            "mapping", self._step, lambda name: metrics.loop_errors.labels(name).inc()
        )

    def resume(
        self,
        mapper: Mapper,
        position: int,
        tail: Iterator[StoredScan],
        *,
        saver: "Saver",
        helpers: ThreadPoolExecutor,
        cores: int,
    ) -> None:
        """Go on from a checkpoint and the scans stored since; to be called before `begin`.

        Args:
            mapper: of the checkpoint, which goes up to `position` in the journal.
            position: see above.
            tail: scans beyond it. Until they are in the answers the map is being restored.
            saver: is offered the map after every step.
            helpers: train and calibrate until then, with nobody to give way to.
            cores: as many as there are helpers.
        """
        self._adopt(mapper)
        self._tail, self._saver = Tail(tail, position, self._beams_max), saver
        self._position = position
        self._helpers = helpers
        self._training.borrow(helpers, cores)

    def begin(self) -> None:
        """Let the thread, which gets the kernels ready as soon as it is started, go on to work."""
        with self._changed:
            self._begun = True
            self._changed.notify_all()

    def _adopt(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._integrated = mapper.scan_count
        self._training = self._new_training(mapper)
        self.state = MapState(mapper.snapshot(), scans_integrated=self._integrated)

    @property
    def restoring(self) -> bool:
        """Whether answers would come from a map that is not yet what it was."""
        return self._tail is not None

    @property
    def _reading_tail(self) -> bool:
        return self._tail is not None and self._tail.held_any and self._restored is None

    @property
    def backlog(self) -> int:
        """Stored scans that are not integrated yet."""
        return self._backlog

    def trouble(self) -> str | None:
        """Why the map is not kept up to date; None when it is."""
        if not self._warm and self.worker.trouble() is None:
            return "the numerical kernels are being compiled"
        if (tail := self._tail) is not None and self.worker.trouble() is None:
            return tail.trouble or f"the map is being restored, {self._integrated} scans are in it"
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

    def flush(self, ticket: int, *, calibrates: bool = True) -> "Future[None]":
        """Give a future that is done once all scans up to `ticket` are in the answers.

        Cancel it to give up. It fails with StoppingError when the service stops first.
        """
        flush = Flush(ticket, calibrates)
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
        self.give_up_flushes()

    def give_up_flushes(self) -> None:
        """Tell who waits for a flush that the service is shutting down."""
        with self._changed:
            flushes, self._flushes = self._flushes, []
        for flush in flushes:
            if flush.done.set_running_or_notify_cancel():
                flush.done.set_exception(StoppingError("the service is shutting down"))

    def _step(self) -> bool:
        if not self._warm:
            warm_up(self._config)
            self._warm = True
            with self._changed:
                self._changed.wait_for(lambda: self._begun or self._stopping)
        if not self._wait():
            self.give_up_flushes()
            return False
        self._integrate()
        # What is trained before the end of the tail would be trained again there.
        swap = None if self._reading_tail else self._training.step()
        self._publish()
        if swap is not None:
            news = MapChanged(swap.snapshot.version, swap.snapshot.changed_bounds)
            self._events.publish(news)
        self._settle({} if swap is None else swap.turns)
        if self._saver is not None and not self.restoring:
            self._saver.offer(self._mapper, self._position - len(self._current))
        return True

    def save(self) -> None:
        """Save the map once its thread has ended."""
        if self._saver is not None and not self.restoring and not self.worker.is_alive():
            self._saver.save_now(self._mapper, self._position - len(self._current))

    def _wait(self) -> bool:
        """Wait for something to do, and take it; False when it is time to end."""
        with self._changed:
            self._changed.wait_for(
                lambda: (
                    self._stopping
                    or self._poked
                    or self.restoring
                    or bool(self._current or self._batches)
                ),
                timeout=self._seconds_to_wait(),
            )
            self._poked = False
            if self._stopping:
                return False
            # All that waits: a step of training after each batch would be one after each scan.
            room = 0 if self._current or self.restoring else _TAIL_SCANS
            while self._batches and len(self._current) < room:
                batch = self._batches.popleft()
                self._current.extend(batch.records)
                self._current_ticket, self._position = batch.ticket, batch.position
        if not self._current and self._tail is not None:
            self._read_tail(self._tail)
        return True

    def _seconds_to_wait(self) -> float | None:
        swap_s = self._training.seconds_to_swap()
        look_s = self._training.seconds_to_look()
        save_s = None if self._saver is None else self._saver.seconds_to_save()
        return min((s for s in (swap_s, look_s, save_s) if s is not None), default=None)

    def _read_tail(self, tail: Tail) -> None:
        """Take some scans from the journal; at its end the map is restored when it is trained."""
        self._current.extend(tail.take(_TAIL_SCANS))
        self._position = tail.position
        if self._current:
            self._backlog += len(self._current)
        elif tail.trouble is None and self._caught_up(tail):
            logger.info("the map is restored: scans=%d", self._integrated)
            self._tail = None
            self._training.give_back()
            if self._helpers is not None:
                self._helpers.shutdown(wait=False)
            if self._saver is not None and tail.held_any:
                self._saver.hurry()
        else:
            with self._changed:
                self._changed.wait_for(lambda: self._poked or self._stopping, timeout=_SLICE_S)

    def _caught_up(self, tail: Tail) -> bool:
        """Whether the map is trained on all that was read; without any it is what was saved."""
        if not tail.held_any:
            return self._training.idle
        if self._restored is None:
            unknown = self._mapper.snapshot().link == Link()  # none was ever fitted to this map
            self._restored = self.flush(self._settled_ticket, calibrates=unknown)
        return self._restored.done()

    def _poke(self) -> None:
        with self._changed:
            self._poked = True
            self._changed.notify_all()

    def _integrate(self) -> None:
        done = 0
        slice_s = _LONG_SLICE_S if self._backlog > _BACKLOG_SCANS else _SLICE_S
        end_s = self._clock.monotonic_s() + slice_s
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
        if record.withheld is not None:
            self._refuse(record, record.withheld)
            return
        try:
            with self._metrics.update_seconds.time():
                report = self._mapper.update(record.scan)
        except InvalidScanError as error:
            self._refuse(record, error.reason)
            logger.debug("scan of %s not integrated: %s", record.robot, error)
        except Exception:
            self._refuse(record, "internal_error")
            logger.exception("scan %d of %s broke the mapper", record.scan.seq, record.robot)
        else:
            self._integrated += 1
            self._metrics.observations_new.inc(report.new_observations)
            if not self.restoring:
                lag_s = self._clock.unix_s() - record.received_unix_s
                self._metrics.lag_seconds.observe(max(0.0, lag_s))

    def _refuse(self, record: ScanRecord, reason: str) -> None:
        self._metrics.scans_refused.labels(reason).inc()
        self._fleet.refused_scans(record.robot, reason)

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
        splits = self._mapper.take_splits()
        with self._changed:
            flushes, self._flushes = self._flushes, []
        dirty = self.state.dirty
        if any(f.missing is None and f.ticket <= self._settled_ticket for f in flushes):
            # Who asks for all evidence gets all, also what alone would not be worth a training.
            self._mapper.refresh()
            dirty = self._mapper.dirty_ids()
            self._poke()
        waiting = []
        for flush in flushes:
            flush.follow(splits)
            flush.note(turns)
            over = flush.advance(self._settled_ticket, dirty, self._training.turn)
            if over and flush.calibrates:
                if flush.calibration is None:
                    flush.calibration = self._training.calibrate()
                over = self._training.calibrated(flush.calibration)
            if over:
                if flush.done.set_running_or_notify_cancel():
                    flush.done.set_result(None)
            elif not flush.done.cancelled():
                waiting.append(flush)
        with self._changed:
            self._flushes += waiting
