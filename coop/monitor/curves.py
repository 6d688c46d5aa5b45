"""What a live page draws: a few figures of a run since the page began, at evenly spaced moments."""

from __future__ import annotations

from coop.common.messaging.messages.status import LearnerStatus

MOST = 400  # points; with one more, every second one is dropped

Point = list[float | None]
COLUMNS = (
    *("env_steps", "env_steps_per_s", "updates_per_s", "ratio", "ratio_target", "ahead", "least", "most"),
    *("td_error", "loss", "q_abs_mean", "q_bound", "q_gap", "sample_age_mean", "sample_age_p95", "weight_lag_mean"),
)


class Curves:
    """Keeps at most `MOST` points; with `add` they are of every status, then of every second one, and so on.

    points: the oldest first, each with a value for every name of `COLUMNS`; None where it is not known.
    """

    def __init__(self) -> None:
        self.points: list[Point] = []
        self._every = 1
        self._seen = 0

    def add(self, status: LearnerStatus) -> None:
        """Note a new status; steps that go back, after a resumption from an epoch, begin the curves anew."""
        point = _point(status)
        if self.points and status.env_steps < (self.points[-1][0] or 0):
            self.points, self._every, self._seen = [], 1, 0
        if self._seen % self._every == 0:
            self.points.append(point)
        self._seen += 1
        if len(self.points) > MOST:
            self.points = self.points[::2]
            self._every *= 2


def _point(status: LearnerStatus) -> Point:
    known: dict[str, float | None] = {}
    if (ratio := status.ratio) is not None:
        known = {
            "ratio": ratio.measured, "ratio_target": ratio.target, "least": ratio.least, "most": ratio.most,
            "ahead": None if ratio.measured is None else ratio.ahead,  # the band holds from the first update on
        }  # fmt: skip
    return [known.get(name, getattr(status, name, getattr(status.measured, name, None))) for name in COLUMNS]
