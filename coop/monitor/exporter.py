"""Serves a learner's status to Prometheus (extra `prometheus`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from coop.common.errors import UsageError
from coop.common.messaging.messages.status import LearnerStatus
from coop.common.process.ports import http_address

COUNTERS = {
    "env_steps": "environment steps",
    "updates": "updates",
    "episodes": "episodes that have ended",
    "bad_messages": "messages that the learner refused",
    "faults": "errors of this program that the learner survived",
}
GAUGES = {
    "return_mean_100": "mean return of the last 100 episodes",
    "epsilon": "share of random actions",
    "s": "scale of s, the exploration of error-driven learning",
    "env_steps_per_s": "environment steps per second",
    "updates_per_s": "updates per second",
    "seconds": "seconds that the run has taken",
    "acting": "number of the network that acts and learns",
    "size": "transitions in the replay table",
    "capacity": "capacity of the replay table",
}
RATIO = {
    "target": "replay ratio as set, updates per environment step",
    "measured": "replay ratio since learning began",
    "ahead": "environment steps by which acting is ahead of learning",
    "least": "least value of coop_ratio_ahead that the limiter allows",
    "most": "largest value of coop_ratio_ahead that the limiter allows",
}
MEASURED = {
    "td_error": "mean absolute TD error",
    "loss": "mean loss",
    "q_gap": "mean distance between the two networks' Q-values",
    "q_abs_mean": "mean absolute Q-value",
    "q_bound": "largest absolute Q-value that the rewards seen allow",
    "sample_age_mean": "mean age of the samples, environment steps",
    "sample_age_p95": "95th percentile of the age of the samples",
    "reuse_mean": "mean number of draws of a sample so far",
    "evicted_unsampled": "share of transitions evicted without ever being drawn",
    "weight_lag_mean": "updates by which the weights were old that played the samples",
}


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
        for name, text in COUNTERS.items():
            counter = CounterMetricFamily(f"coop_{name}", text, labels=list(labels))
            counter.add_metric(list(labels.values()), getattr(status, name))
            yield counter
        for source, prefix, told in (
            (status, "", GAUGES),
            (status.ratio, "ratio_", RATIO),
            (status.measured, "", MEASURED),
        ):
            for name, text in told.items():
                value = getattr(source, name, None)
                if value is not None:
                    yield _gauge(f"coop_{prefix}{name}", text, labels, {(): value})
        members: Values = {(role,): float(number) for role, number in status.connected.items()}
        yield _gauge("coop_members", "connected processes", labels, members, ("role",))
        yield _gauge(
            "coop_members_lost", "lost processes that no other has replaced", labels, {(): len(status.missing)}
        )
        waits: Values = {(wait.who, wait.for_whom): wait.share for wait in status.waits}
        text = "share of the time in which one side waits for another"
        yield _gauge("coop_wait_share", text, labels, waits, ("who", "for_whom"))


def _gauge(
    name: str,
    text: str,
    labels: dict[str, str],
    values: Values,
    keys: tuple[str, ...] = (),
) -> GaugeMetricFamily:
    gauge = GaugeMetricFamily(name, text, labels=[*labels, *keys])
    for key, value in values.items():
        gauge.add_metric([*labels.values(), *key], value)
    return gauge


@contextmanager
def exported(address: str, read: Callable[[], LearnerStatus | None]) -> Iterator[int]:
    """Serve the metrics at PORT or HOST:PORT; yield the port. Raises UsageError if that can't be done."""
    host, port = http_address("--prometheus", address)
    registry = CollectorRegistry(auto_describe=False)
    registry.register(StatusCollector(read))
    try:
        server, thread = start_http_server(port, host, registry)
    except OSError as error:
        raise UsageError(f"--prometheus {address}: {error.strerror or error}") from error
    try:
        yield server.server_port
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
