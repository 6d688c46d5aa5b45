"""Serves a learner's status to Prometheus (extra `prometheus`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from coop.common.messaging.messages.status import LearnerStatus
from coop.common.metrics import METRICS
from coop.monitor.facts import values
from coop.monitor.web import Document, WebServer

Values = dict[tuple[str, ...], float]  # by the values of the labels that a metric has of its own


class StatusCollector(Collector):
    """Turns the newest status into metrics whenever it is asked. read: the status; None before the first."""

    def __init__(self, read: Callable[[], LearnerStatus | None]) -> None:
        self._read = read

    def collect(self) -> Iterable[Metric]:
        """Yield the metrics; none before the first status."""
        status = self._read()
        if status is None:
            return
        labels = {"env": status.env, "method": status.method, "seed": str(status.seed)}
        known = values(status)
        for metric in METRICS:
            if metric.name in known:
                family = CounterMetricFamily if metric.counter else GaugeMetricFamily
                of_run = family(f"coop_{metric.name}", metric.meaning, labels=list(labels))
                of_run.add_metric(list(labels.values()), known[metric.name])
                yield of_run
        members: Values = {(role,): float(number) for role, number in status.connected.items()}
        yield _gauge("coop_members", "connected processes", labels, members, ("role",))
        yield _gauge(
            "coop_members_lost", "lost processes that no other has replaced", labels, {(): len(status.missing)}
        )
        waits: Values = {(wait.who, wait.for_whom): wait.share for wait in status.waits}
        text = "share of the time in which one side waits for another"
        yield _gauge("coop_wait_share", text, labels, waits, ("who", "for_whom"))


def _gauge(name: str, text: str, labels: dict[str, str], known: Values, keys: tuple[str, ...] = ()) -> Metric:
    gauge = GaugeMetricFamily(name, text, labels=[*labels, *keys])
    for key, value in known.items():
        gauge.add_metric([*labels.values(), *key], value)
    return gauge


@contextmanager
def exported(address: str, read: Callable[[], LearnerStatus | None]) -> Iterator[int]:
    """Serve the metrics at PORT or HOST:PORT; yield the port. Raises UsageError if that can't be done."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(StatusCollector(read))
    document = {path: lambda: Document(CONTENT_TYPE_LATEST, generate_latest(registry)) for path in ("/", "/metrics")}
    with closing(WebServer("--prometheus", address, document)) as server:
        yield server.port
