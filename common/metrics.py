"""The table of metrics: each number that a run tells of itself, what it means, and where it is shown.

The columns of metrics.jsonl, `measured` in the learner's status, the lines of the screen, the charts of the page,
Prometheus, the tags of TensorBoard and the table in docs/watching.md follow from it. A new metric is an entry here, and
a value of that name where it is measured: in `coop.learner.telemetry.Telemetry.row`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

SPEED = "Speed"
RATIO = "Replay ratio, updates per environment step"
AHEAD = "Steps by which acting is ahead of learning"
ERRORS = "Mean |TD error| and loss"
Q_VALUES = "Mean |Q| against its bound"
AGE = "Age of the samples, environment steps"
TERMINAL = "Share of terminal transitions"
FORGETTING = "Forgetting: the first 64 transitions drawn"


@dataclass(frozen=True)
class Metric:
    """A metric. The names in metrics.jsonl, in the status and for Prometheus do not change.

    name: unique. unit: empty for a plain number. column: of metrics.jsonl; empty if it is none. field: of the learner's
    status, as "ratio.target"; empty if it is none; all of `measured` are columns. counter: grows only.
    plotted: its column is in TensorBoard, at `tag`, or at train/COLUMN if that is empty.
    line, words: the label of a line of screen and page, and what it says there of the value, after "; " or, if it
        begins with a space or a comma, right behind the one before.
    chart, curve, bound: title of a chart on the page, name of the line in it, and whether it bounds another.
    listed: it is a list of numbers; only the page shows one that is in the status.
    """

    name: str
    meaning: str
    unit: str = ""
    column: str = ""
    field: str = ""
    counter: bool = False
    plotted: bool = True
    tag: str = ""
    line: str = ""
    words: str = ""
    chart: str = ""
    curve: str = ""
    bound: bool = False
    listed: bool = False

    @property
    def prometheus(self) -> str:
        """Its name for Prometheus; empty if it is not served."""
        return f"coop_{self.name}{'_total' if self.counter else ''}" if self.field and not self.listed else ""

    @property
    def tensorboard(self) -> str:
        """Its tag; empty if it has none."""
        return (self.tag or f"train/{self.column}") if self.column and self.plotted else ""


def _live(name: str, meaning: str, unit: str = "", **shown: Any) -> Metric:  # noqa: ANN401 (fields of Metric)
    """A metric of the moment: a field of the status, and a column too if `column` names one."""
    return Metric(name, meaning, unit, **{"field": name, **shown})


def _row(name: str, meaning: str, unit: str = "", **shown: Any) -> Metric:  # noqa: ANN401 (as above)
    """A metric over the updates since the last row of metrics.jsonl: a column, and in the status as `measured`."""
    return Metric(name, meaning, unit, column=name, **{"field": f"measured.{name}", **shown})


def _list(name: str, meaning: str, unit: str = "", **shown: Any) -> Metric:  # noqa: ANN401 (as above)
    """A column that holds a list of numbers."""
    return Metric(name, meaning, unit, column=name, plotted=False, listed=True, **shown)


METRICS = (
    _live("env_steps", "environment steps: one decision of one emulator each", "steps", counter=True),
    _live("updates", "updates done; after a resumption they go on from its checkpoint", "updates", counter=True),
    _live("episodes", "episodes that have ended", "episodes", counter=True),
    _live("bad_messages", "messages that the learner refused", "messages", counter=True),
    _live("faults", "errors of this program that the learner survived", "errors", counter=True),
    Metric("time", "the time of the row, since 1970", "s", column="time", plotted=False),
    Metric("env_step", "environment steps at the row", "steps", column="env_step", plotted=False),
    Metric("update", "updates at the row", "updates", column="update"),
    _live("return_mean_100", "mean return of the last 100 episodes; 0 before the first"),
    _live("seconds", "time that the run has taken, over all its resumptions", "s"),
    _live("acting", "number of the network that acts and learns", column="acting"),
    _live("epsilon", "share of random actions", column="epsilon", tag="charts/epsilon",
        line="exploration", words="{:.1%} random actions (epsilon)"),
    _live("s", "scale of s in B = U (S + sI) V^T, the exploration of error-driven learning", column="s",
        line="exploration", words=", s = {:.3g} (error-driven)"),
    _live("env_steps_per_s", "speed of acting: live over the last 2 s, in a row since the last one", "steps/s",
        column="env_steps_per_s", tag="charts/SPS",
        line="speed", words="{:,.0f} steps/s", chart=SPEED, curve="steps/s"),
    _live("updates_per_s", "speed of learning, likewise", "updates/s", column="updates_per_s",
        tag="charts/updates_per_second", line="speed", words=", {:,.0f} updates/s", chart=SPEED, curve="updates/s"),
    _live("size", "transitions in the replay table", "transitions", line="table", words="{:,}"),
    _live("capacity", "capacity of the replay table", "transitions", line="table", words=" of {:,} transitions"),
    Metric("replay_size", "transitions in the replay table at the row", "transitions", column="replay_size"),
    _live("ratio_measured", "replay ratio since learning began", "updates/step", field="ratio.measured",
        chart=RATIO, curve="measured"),
    _live("ratio_target", "replay ratio as set", "updates/step", field="ratio.target",
        chart=RATIO, curve="target", bound=True),
    _live("ratio_ahead", "by how much acting is ahead of learning", "steps", field="ratio.ahead",
        chart=AHEAD, curve="ahead"),
    _live("ratio_least", "least value of ratio_ahead that the limiter allows", "steps", field="ratio.least",
        chart=AHEAD, curve="least", bound=True),
    _live("ratio_most", "largest value of ratio_ahead that the limiter allows", "steps", field="ratio.most",
        chart=AHEAD, curve="most", bound=True),
    _row("td_error", "mean absolute TD error", tag="losses/td_error", chart=ERRORS, curve="|TD error|"),
    _row("loss", "mean loss", tag="losses/td_loss", chart=ERRORS, curve="loss"),
    _row("terminal_share", "share of terminal transitions in the replay table", line="table", words="{:.2%} terminal",
        chart=TERMINAL, curve="in the table"),
    _row("terminal_drawn_share", "share of terminal transitions among those drawn", line="table",
        words=" ({:.2%} of those drawn)", chart=TERMINAL, curve="drawn"),
    _row("sample_age_mean", "mean age of the transitions drawn", "steps", line="table",
        words="samples {:,.0f} steps old", chart=AGE, curve="mean"),
    _row("sample_age_p95", "95th percentile of the age of the transitions drawn", "steps", line="table",
        words=" (p95 {:,.0f})", chart=AGE, curve="p95"),
    _list("sample_age_histogram", "transitions drawn that were 0, 1, 2 to 3, 4 to 7, ... steps old", "transitions",
        field="measured.sample_age_histogram"),
    _row("reuse_mean", "mean number of draws of a transition drawn, so far", "draws"),
    _list("reuse_histogram", "transitions drawn for the 1st time, the 2nd or 3rd, the 4th to 7th, ...", "transitions"),
    _row("distinct_share", "share of distinct transitions in a batch"),
    _row("evicted_unsampled", "share of transitions evicted without ever being drawn"),
    _row("weight_lag_mean", "age of the weights that played the transitions drawn", "updates", line="weight lag",
        words="samples were played with weights {:,.0f} updates old",
        chart="Weight lag of the samples, updates", curve="mean"),
    _row("q1_mean", "mean Q-value of network 1 on the archive"),
    _row("q2_mean", "mean Q-value of network 2 on the archive"),
    _row("q_abs_mean", "mean absolute Q-value of both networks on the archive", line="Q-values",
        words="mean |Q| {:.4g}", chart=Q_VALUES, curve="mean |Q|"),
    _row("q_bound", "largest absolute Q-value that the rewards seen allow; none if gamma is 1", line="Q-values",
        words=" of at most {:.4g}", chart=Q_VALUES, curve="bound", bound=True),
    _row("q_gap", "mean distance between the two networks' Q-values on the archive", line="Q-values",
        words="the networks differ by {:.3g} (Q gap)",
        chart="Q gap: distance between the two networks' Q-values", curve="Q gap"),
    _row("archive_td_error", "mean absolute TD error of the archive, as an update would find it",
        chart=FORGETTING, curve="|TD error|"),
    _row("archive_drift", "mean absolute change of Q on the archive since the last row",
        chart=FORGETTING, curve="drift of Q"),
    _row("policy_churn", "share of the archive's states whose greedy action has changed since the last row"),
    _row("dormant_share", "share of hidden units that are dormant"),
    _list("dormant_by_layer", "the same, by layer"),
    _row("effective_rank", "effective rank of the last hidden layer"),
    _list("effective_rank_by_layer", "effective rank, by layer"),
)  # fmt: skip

COLUMNS = frozenset(metric.column for metric in METRICS if metric.column)
MEASURED = {metric.name: metric.listed for metric in METRICS if metric.field.startswith("measured.")}
"""What a status carries of a row of metrics.jsonl, by name; True if it is a list."""
TAGS = {metric.column: metric.tensorboard for metric in METRICS if metric.tensorboard}
"""Tags of TensorBoard by column of metrics.jsonl."""
