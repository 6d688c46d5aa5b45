"""The paper's Table 1 (arXiv 2110.15305): mean and standard deviation over the last 100 episodes."""

from __future__ import annotations

import re

TABLE_1: dict[str, dict[str, tuple[float, float]]] = {
    "cartpole": {"dqn": (193.6, 0.71), "edql": (199.6, 0.82), "g-coop": (200.0, 0.82), "coop": (200.0, 0.2123)},
    "breakout": {"dqn": (287.0, 78.0), "edql": (290.0, 55.0), "g-coop": (314.0, 15.0), "coop": (313.0, 25.0)},
    "spaceinvaders": {"dqn": (1139, 158), "edql": (980, 163), "g-coop": (1174, 163), "coop": (1144, 121)},
    "pong": {"dqn": (18.9, 2.12), "edql": (19.11, 1.88), "g-coop": (18.91, 1.32), "coop": (19.15, 2.1)},
}  # fmt: skip


def table_1(env_id: str) -> dict[str, tuple[float, float]]:
    """The column of an environment, (mean, sd) by method; empty if the paper has none."""
    name = re.sub(r"^.*/|-v\d+$|[^A-Za-z]", "", env_id).lower()
    return TABLE_1.get(name, {})
