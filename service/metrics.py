"""What Prometheus sees. Every service has its own registry, so two can live in one process."""

from collections.abc import Callable, Iterable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, Metric
from prometheus_client.registry import Collector

_SHORT_S = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0, 10.0)


class Metrics:
    """All metrics of one service, named ``gpom_*``."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.scans_refused = self._counter(
            "gpom_scans_refused", "scans that did not enter the map, by reason", "reason"
        )
        self.scans_lost = self._counter(
            "gpom_scans_lost", "scans that never came, told by gaps in sequence numbers"
        )
        self.observations_new = self._counter(
            "gpom_observations_new", "observations that scans added to the map"
        )
        self.journal_failures = self._counter(
            "gpom_journal_failures", "commits that failed; nothing of them was acknowledged"
        )
        self.checkpoint_failures = self._counter(
            "gpom_checkpoint_failures", "checkpoints of the map that could not be saved"
        )
        self.training_failures = self._counter(
            "gpom_training_failures", "training jobs that raised"
        )
        self.loop_errors = self._counter(
            "gpom_loop_errors", "unexpected errors that a thread survived", "thread"
        )
        self.remote_queries = self._counter(
            "gpom_remote_queries", "queries over zenoh, by outcome", "outcome"
        )
        self.remote_seconds = self._seconds(
            "gpom_remote_query_seconds", "time to answer a query over zenoh, once its turn came"
        )
        self.http_requests = self._counter(
            "gpom_http_requests", "HTTP requests", "route", "method", "status"
        )
        self.http_seconds = self._seconds(
            "gpom_http_request_seconds", "time to answer an HTTP request", "route"
        )
        self.commit_seconds = self._seconds(
            "gpom_journal_commit_seconds", "time to store one batch of scans"
        )
        self.checkpoint_seconds = self._seconds(
            "gpom_checkpoint_seconds", "time to save one checkpoint of the map"
        )
        self.update_seconds = self._seconds(
            "gpom_scan_integration_seconds", "time to integrate one scan"
        )
        self.lag_seconds = self._seconds(
            "gpom_scan_lag_seconds", "from the arrival of a scan to its evidence being in the map"
        )
        self.train_seconds = self._seconds("gpom_expert_training_seconds", "time of one job")
        self.swap_seconds = self._seconds(
            "gpom_map_swap_seconds", "time to swap trained experts into the map"
        )

    def count(self, name: str, help_text: str, read: Callable[[], int]) -> None:
        """Export a number that only grows, and that is kept elsewhere."""
        self.registry.register(_ReadCounter(name, help_text, read))

    def gauge(self, name: str, help_text: str, read: Callable[[], float]) -> None:
        """Export a number that goes up and down, and that is kept elsewhere."""
        Gauge(name, help_text, registry=self.registry).set_function(read)

    def exposition(self) -> bytes:
        """All of it in Prometheus' text format."""
        return generate_latest(self.registry)

    def _counter(self, name: str, help_text: str, *labels: str) -> Counter:
        return Counter(name, help_text, labels, registry=self.registry)

    def _seconds(self, name: str, help_text: str, *labels: str) -> Histogram:
        return Histogram(name, help_text, labels, buckets=_SHORT_S, registry=self.registry)


class _ReadCounter(Collector):
    def __init__(self, name: str, help_text: str, read: Callable[[], int]) -> None:
        self._name = name
        self._help = help_text
        self._read = read

    def collect(self) -> Iterable[Metric]:
        yield CounterMetricFamily(self._name, self._help, value=self._read())

    def describe(self) -> Iterable[Metric]:
        yield CounterMetricFamily(self._name, self._help)
