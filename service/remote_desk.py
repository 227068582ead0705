"""Questions about points that come over zenoh: the same as POST /v1/query, by the same pool.

zenoh does not tell who asks, so all who do are one client: what they have open beyond their share
is told from a service that is short, and leaves room for those who ask by HTTP.
"""

import logging
import threading
from collections.abc import Callable

from gpom_core.errors import GpomError
from gpom_core.snapshot import Snapshot
from service.clock import Clock
from service.errors import ExcessError, PayloadTooLargeError
from service.metrics import Metrics
from service.points import predict, read_request, write_answer
from service.problems import problem_of
from service.query_desk import QueryDesk
from service.settings import HttpSettings
from service.source import RemoteQuery, RemoteReply

logger = logging.getLogger(__name__)


class RemoteDesk:
    """Answers each question exactly once, whatever happens. Safe to use from any thread.

    Args:
        open_max: questions that may be open at once.
        http: other limits, which are those of POST /v1/query.
        desk: runs heavy queries, of HTTP too.
        snapshot: the map as it is now; may raise NotReadyError.
    """

    def __init__(
        self,
        open_max: int,
        http: HttpSettings,
        *,
        desk: QueryDesk,
        snapshot: Callable[[], Snapshot],
        metrics: Metrics,
        clock: Clock,
    ) -> None:
        self._open_max = open_max
        self._http = http
        self._desk = desk
        self._snapshot = snapshot
        self._metrics = metrics
        self._clock = clock
        self._open = 0
        self._lock = threading.Lock()

    def take(self, query: RemoteQuery) -> None:
        """Answer soon, or refuse now."""
        with self._lock:
            excess = self._open >= self._open_max
            self._open += not excess
        if excess:
            query.reply(self._refuse(self._excess()))
            return
        try:
            self._desk.submit(lambda: self._finish(query))
        except GpomError as error:
            self._leave()
            query.reply(self._refuse(error))

    def _leave(self) -> None:
        with self._lock:
            self._open -= 1

    def _finish(self, query: RemoteQuery) -> None:
        answer = self._answer(query)
        self._leave()  # first: who has the answer may ask again
        query.reply(answer)

    def _answer(self, query: RemoteQuery) -> RemoteReply:
        start_s = self._clock.monotonic_s()
        try:
            if (size := len(query.body)) > self._http.body_bytes_max:
                allowed = self._http.body_bytes_max
                message = (
                    f"the body has {size} bytes; at most {allowed} are allowed: split the query"
                )
                raise PayloadTooLargeError(message)
            # zenoh calls bytes of no stated type application/octet-stream or zenoh/bytes.
            request = read_request(query.body, query.media_type, query.fusion, query.method)
            snapshot = self._snapshot()
            points_max = self._http.query_points_max
            prediction = predict(snapshot, request, points_max, self._desk.check)
            body = write_answer(prediction, snapshot.version, query.media_type)
            self._metrics.remote_seconds.observe(self._clock.monotonic_s() - start_s)
        except GpomError as error:
            return self._refuse(error)
        except Exception as error:  # the asker must not wait for its timeout
            logger.exception("a remote query failed")
            return self._refuse(error)
        self._metrics.remote_queries.labels("answered").inc()
        return RemoteReply(body, query.media_type)

    def _excess(self) -> ExcessError:
        message = (
            f"{self._open_max} queries over zenoh are open, and more are not allowed at once, "
            "whoever asks (setting zenoh.queries_max): wait for answers, or ask by HTTP"
        )
        return ExcessError(message, self._open_max, self._http.retry_after_s)

    def _refuse(self, error: Exception) -> RemoteReply:
        self._metrics.remote_queries.labels("refused").inc()
        problem = problem_of(error)
        return RemoteReply(problem.encoded(), problem.MEDIA_TYPE, is_error=True)
