"""The service without its web interface: the parts, put together, started and stopped in order."""

import logging
import os
import secrets
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Protocol

import threadpoolctl

from gpom_core.mapper import Mapper
from service.archive import Archive
from service.clock import Clock, SystemClock
from service.errors import NotReadyError
from service.events import EventBus, RobotChanged
from service.fleet import Fleet, IntakeStatus
from service.ingest import Acknowledge, Ingest, acknowledge_nothing
from service.journal import Journal, NoJournal
from service.mapping import MapKeeper, MapState
from service.metrics import Metrics
from service.priority import be_nice
from service.query_desk import QueryDesk
from service.raster_store import RasterStore
from service.remote_desk import RemoteDesk
from service.saver import Saver
from service.sequences import Cursor, SensorKey
from service.settings import Settings
from service.source import RemoteQuery, ScanSource
from service.tile_store import TileStore

logger = logging.getLogger(__name__)

_TRAINING_NICE = 10  # nobody waits for it as for an answer, and it takes all it can get
_DRAIN_S = 1.5  # what was received before the end is stored and integrated, if that is quick


class _Part(Protocol):
    def trouble(self) -> str | None: ...


@dataclass(slots=True)
class Ports:
    """What a service is connected to; the defaults reach nothing outside the process.

    With an archive, which brings its own journal, the map outlives the process.
    """

    source: ScanSource
    journal: Journal = field(default_factory=NoJournal)
    archive: Archive | None = None
    clock: Clock = field(default_factory=SystemClock)
    acknowledge: Acknowledge = acknowledge_nothing


class MapService:
    """One live map of one site. Start it once, stop it once."""

    def __init__(self, settings: Settings, ports: Ports) -> None:
        self.settings = settings
        self.metrics = Metrics()
        self.events = EventBus(settings.http.event_clients_max)
        self.fleet = Fleet(settings.ingest.robots_max)
        self.queries = QueryDesk(
            settings.http.query_threads,
            settings.http.queries_waiting_max,
            settings.http.retry_after_s,
        )
        self._remote = RemoteDesk(
            settings.zenoh.queries_max,
            settings.http,
            desk=self.queries,
            snapshot=lambda: self.state.snapshot,
            metrics=self.metrics,
            clock=ports.clock,
        )
        self._tile_desk = QueryDesk(
            settings.http.tile_threads,
            settings.http.tiles_waiting_max,
            settings.http.retry_after_s,
            name="gpom-tile",
        )
        self.tiles = TileStore(self._tile_desk, settings.http.tile_cache_bytes_max)
        self.rasters = RasterStore(self.queries, settings.http.grid_cache_bytes_max, ports.clock)
        self.instance = secrets.token_hex(4)  # versions of two runs have nothing in common
        self._ports = ports
        self._journal = ports.journal if ports.archive is None else ports.archive.journal
        self._saver: Saver | None = None
        self._pool: ThreadPoolExecutor | None = None
        self._starting: str | None = "the service is starting"  # what it does until it has started
        self._received_before = 0
        self._mapping = MapKeeper(
            Mapper(settings.map),
            self._new_pool(),
            settings.map,
            ingest=settings.ingest,
            training=settings.training,
            events=self.events,
            fleet=self.fleet,
            metrics=self.metrics,
            clock=ports.clock,
            renew_executor=self._new_pool,
        )
        self._ingest = Ingest(
            settings.ingest,
            journal=self._journal,
            hand_on=self._mapping.offer,
            fleet=self.fleet,
            events=self.events,
            metrics=self.metrics,
            clock=ports.clock,
            acknowledge=ports.acknowledge,
        )
        self._export_metrics()

    def _new_pool(self) -> ThreadPoolExecutor:
        """Workers for training, in place of those there were."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
        workers = self.settings.training.workers
        self._pool = ThreadPoolExecutor(
            workers, "gpom-train", initializer=be_nice, initargs=(_TRAINING_NICE,)
        )
        return self._pool

    @property
    def state(self) -> MapState:
        """The map as it is now; hold on to it to answer consistently.

        Raises:
            NotReadyError: it is being restored; answers would be those of an older map.
        """
        if self._starting is not None or self._mapping.restoring:
            raise NotReadyError(self.troubles() or ["the map is being restored"])
        return self._mapping.state

    @property
    def scans_received(self) -> int:
        """Scans that arrived, whatever became of them; of runs before, those that were stored."""
        return self._received_before + self._ingest.queue.received

    @property
    def scans_waiting(self) -> int:
        """Scans on their way into the map."""
        return len(self._ingest.queue) + self._mapping.backlog

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Where robots can send scans."""
        return self._ports.source.endpoints()

    def start(self) -> None:
        """Load what was kept, start the threads, then let scans in. That may take a while.

        Meanwhile another thread may ask everything of it: `troubles` tells how far it is.

        Raises:
            JournalError, MapFileError: what was kept cannot be read; it is left as it is.
            SourceError: scans cannot be let in; everything is stopped again.
        """
        # Small factorisations get 10-20 times slower when each tries to use all cores.
        threadpoolctl.threadpool_limits(1)
        self._mapping.worker.start()  # gets the kernels ready while the map is loaded
        try:
            self._resume()
            self._starting = "the zenoh session is being opened"
            # Before the threads: what arrives waits in the queue, and what fails, fails fast.
            self._ports.source.open(self)
        except BaseException:
            self.stop()
            raise
        self._mapping.begin()
        self._ingest.worker.start()
        self._starting = None

    def _resume(self) -> None:
        archive, journal = self._ports.archive, self._journal
        if archive is None:
            journal.open()
            self._ingest.resume()
            if not journal.durable:
                logger.warning(
                    "no data directory is set: the map is kept in memory and ends with this process"
                )
            return
        self._starting = f"the journal in {archive.directory} is being opened"
        archive.open()
        self._starting = f"the map is being restored from {archive.newest()}"
        # Not in the pool for training, which gives way to others: nobody is served meanwhile.
        cores = os.cpu_count() or 1
        helpers = ThreadPoolExecutor(cores, "gpom-restore")
        try:
            mapper, position = archive.load(helpers)
        except BaseException:
            helpers.shutdown(wait=False)
            raise
        self._saver = Saver(
            archive.save,
            position,
            interval_s=self.settings.journal.checkpoint_interval_s,
            metrics=self.metrics,
            clock=self._ports.clock,
            keep_link=archive.keep_link,
        )
        link = archive.kept_link(position)
        if link is not None:
            mapper.adopt(link)
        tail = journal.replay(position, journal.position)
        self._mapping.resume(
            mapper, position, tail, saver=self._saver, helpers=helpers, cores=cores
        )
        self._ingest.resume()
        self._received_before = sum(robot.scans for robot in self.fleet.robots())

    def hang_up(self) -> None:
        """End what keeps connections open for long: event streams, heavy queries and flushes."""
        self.events.close()
        self.queries.close()
        self._mapping.give_up_flushes()

    def stop(self) -> None:
        """Let no more scans in, finish what is quick to finish, end every thread."""
        self.hang_up()
        self._ingest.queue.close()  # first, so that a blocked source lets go
        self._ports.source.close()
        drained = self._ingest.worker.join(_DRAIN_S)
        self._mapping.stop()
        if not (self._ingest.worker.join(_DRAIN_S) and drained):
            logger.warning("some scans that were received are not stored")
        self._mapping.worker.join(_DRAIN_S)
        if self._saver is not None:
            self._mapping.save()
            self._saver.close()
        self._tile_desk.close()
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
        self._journal.close()
        if self._ports.archive is not None:
            self._ports.archive.close()

    def troubles(self) -> list[str]:
        """Why the service is not ready; empty when it is."""
        if (starting := self._starting) is not None:
            return [starting]
        parts: list[_Part] = [self._ports.source, self._ingest, self._mapping]
        if self._saver is not None:
            parts.append(self._saver)
        return [trouble for part in parts if (trouble := part.trouble()) is not None]

    def flush(self) -> "Future[None]":
        """Give a future that is done once all received so far is integrated and trained."""
        return self._mapping.flush(self._ingest.queue.entered)

    def on_scan(self, robot: str, sensor: str, payload: bytes) -> None:
        """Take a scan; see `service.source.SourceSink`."""
        self._ingest.on_scan(robot, sensor, payload)

    def cursor(self, robot: str, sensor: str) -> Cursor | None:
        """Give the last stored scan of a sensor; see `service.source.SourceSink`."""
        return self._ingest.cursor(SensorKey(robot, sensor))

    def on_presence(self, robot: str, alive: bool) -> None:
        """Note that a robot came or went."""
        news = self.fleet.set_alive(robot, alive)
        if news is not None:
            logger.info("robot=%s alive=%s", robot, alive)
            self.events.publish(RobotChanged(robot, alive))

    def on_intake(self, robot: str, status: IntakeStatus) -> None:
        """Note how scans fare that come without a pose."""
        before = self.fleet.set_intake(robot, status)
        for reason, count in status.dropped.items():
            new = count - (0 if before is None else before.dropped.get(reason, 0))
            self.metrics.scans_refused.labels(reason).inc(max(new, 0))

    def on_refused(self, reason: str, count: int) -> None:
        """Count scans of robots that are not even remembered."""
        self.metrics.scans_refused.labels(reason).inc(count)

    def on_query(self, query: RemoteQuery) -> None:
        """Answer a question that came by the source, from the pool for heavy queries."""
        self._remote.take(query)

    def _export_metrics(self) -> None:
        metrics, queue, mapping = self.metrics, self._ingest.queue, self._mapping
        metrics.count("gpom_scans_received", "scans that arrived", lambda: queue.received)
        metrics.count(
            "gpom_scans_dropped", "scans the full queue threw away", lambda: queue.dropped
        )
        metrics.count(
            "gpom_scans_integrated",
            "scans whose evidence is in the map",
            lambda: mapping.state.scans_integrated,
        )
        metrics.gauge("gpom_queue_scans", "received, not yet decoded", lambda: len(queue))
        metrics.gauge("gpom_backlog_scans", "stored, not yet integrated", lambda: mapping.backlog)
        metrics.gauge("gpom_journal_position", "scans ever stored", lambda: self._journal.position)
        metrics.gauge("gpom_map_version", "version", lambda: mapping.state.snapshot.version)
        metrics.gauge("gpom_experts", "experts", lambda: mapping.state.experts)
        metrics.gauge("gpom_dirty_experts", "to be trained", lambda: len(mapping.state.dirty))
        metrics.gauge(
            "gpom_quarantined_experts", "set aside", lambda: len(mapping.state.quarantined)
        )
        metrics.gauge("gpom_observations", "of all experts", lambda: mapping.state.observations)
        metrics.gauge("gpom_robots", "that were seen", lambda: len(self.fleet.robots()))
        metrics.gauge("gpom_event_clients", "open event streams", lambda: self.events.clients)
        metrics.gauge(
            "gpom_queries", "heavy queries, running or waiting", lambda: self.queries.taken
        )
        metrics.gauge(
            "gpom_tiles", "map tiles being drawn or waiting", lambda: self._tile_desk.taken
        )
        metrics.count("gpom_tiles_drawn", "map tiles drawn", lambda: self.tiles.drawn)
        metrics.gauge("gpom_tile_cache_bytes", "of tiles remembered", lambda: self.tiles.bytes_used)
