"""Lockstep runs of MinAtar in compiled loops: each is to the bit what it is by itself."""

from __future__ import annotations

import numpy as np
import pytest
from test_seeds import PICTURES, assert_as_by_itself, config_of

from coop.common.networks.convolution import ConvolutionNetwork
from coop.common.networks.network import build_network
from coop.common.types import EnvSpec
from coop.learner.edl.polar import LIMITS, _whitened_triples
from coop.lockstep.compiled.conditions import why_not

pytest.importorskip("numba")

OF_PICTURES = {
    "dqn": ("dqn", {"learner": {"batch_size": 32}}),
    "coop, reservoir": ("coop", {"replay": {"eviction": "reservoir"}}),
    "edql, double, s constant": ("edql", {"learner": {"double": True}, "edl": {"noise": "constant"}}),
    "g-coop, double, reservoir, half of the updates, clipped": (
        "g-coop",
        {
            "learner": {"double": True, "loss": "squared"}, "replay": {"eviction": "reservoir", "ratio": 0.5},
            "env": {"clip_rewards": True},
        },
    ),
    "returns over three, ends at a limit": (
        "dqn", {"replay": {"n_step": 3, "ratio": 0.5}, "env": {"max_episode_steps": 13}}
    ),
    "weight-gradient, returns over three": (
        "coop", {"edl": {"feedback": "weight-gradient", "noise": "constant"}, "replay": {"n_step": 3, "ratio": 2.0}}
    ),
    "weight-gradient, two updates a step": (
        "edql",
        {
            "edl": {"feedback": "weight-gradient", "noise": "constant"},
            "replay": {"ratio": 2.0},
            "learner": {"batch_size": 32},
        },
    ),
    "dead units": ("coop", {"learner": {"learning_rate": 0.05}}),
    "six actions, sgd": ("edql", {"learner": {"optimizer": "sgd"}, "env": {"id": "MinAtar/Breakout-v0"}}),
}  # fmt: skip


@pytest.mark.parametrize("case", OF_PICTURES)
def test_pictures_are_played_to_the_bit_as_by_itself(case: str) -> None:
    method, *changes = OF_PICTURES[case]
    config = config_of(method, PICTURES, *changes, preset="minatar-breakout")
    one = config.learner.double or config.replay.n_step > 1
    assert_as_by_itself(config, 460 if config.replay.ratio < 1 else 260, (3,) if one else (3, 4))


def test_pictures_that_fill_no_whole_bytes_are_played_too() -> None:
    """A picture of Freeway has 700 truth values."""
    limit = {"env": {"max_episode_steps": 20, "time_limit_terminal": True}}
    assert_as_by_itself(config_of("dqn", PICTURES, limit, preset="minatar-freeway"), 260, (3,))


@pytest.mark.parametrize("sides", [(10, 10, 7), (5, 7, 3)])
def test_what_the_kernel_sees_is_that_of_the_network(sides: tuple[int, ...]) -> None:
    from coop.lockstep.compiled import picture_loops  # noqa: PLC0415 (after importorskip)
    from coop.lockstep.compiled.tables import Packing  # noqa: PLC0415

    spec = EnvSpec("made/up", sides, "bool", 1, 3)
    network = ConvolutionNetwork(build_network("minatar", spec, (), seed=0))
    pictures, packing = np.random.default_rng(0).random((9, *sides)) < 0.3, Packing(spec)
    rows = packing.rows(pictures)
    np.testing.assert_array_equal(packing.obs(rows), pictures)
    seen = network.activations(pictures.transpose(0, 3, 1, 2).astype(np.float32))[0].T
    down, across = network.places(sides[:2])
    found = np.ones((len(seen), down, across * 9), np.float32)
    picture_loops.windows(rows, np.array((*sides, *network.kernel)), found)
    np.testing.assert_array_equal(found.reshape(seen.shape), seen)


def test_three_actions_are_whitened_as_in_numpy_to_the_bit() -> None:
    """Before the result is rounded to float32; one sample lacks rank."""
    from coop.lockstep.compiled import picture_loops  # noqa: PLC0415 (after importorskip)

    rng, limits = np.random.default_rng(1), LIMITS[4]
    t = rng.standard_normal((2, 50, 3, 20)).astype(np.float32) * 10.0 ** rng.integers(-2, 2, (2, 50, 3, 1))
    e, white = rng.standard_normal((50, 3)).astype(np.float32), np.empty((2, 50, 3))
    for doubtful in (False, True):
        if doubtful:
            t[1, 7, 2] = t[1, 7, 1]
        grams = (t @ t.swapaxes(-1, -2)).astype(np.float32)
        with np.errstate(all="ignore"):
            wanted, where = _whitened_triples(grams.astype(np.float64), e.astype(np.float64), limits)
        sound = picture_loops.whiten_triples(grams, e, limits.square, limits.ratio, limits.inflation, white)
        assert sound is not doubtful
        kept = np.ones((2, 50), bool) if where is None else ~where
        assert kept.sum() == 100 - doubtful
        np.testing.assert_array_equal(white[kept], wanted[kept])


REFUSED_OF_PICTURES = {
    "edl.feedback": {"edl": {"feedback": "weight-gradient", "noise": "normal"}},
    "env": {"env": {"stack": 2}}, "network.kind": {"network": {"kind": "mlp"}},
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED_OF_PICTURES)
def test_what_pictures_are_not_played_side_by_side_says_why(name: str) -> None:
    assert why_not(config_of("coop", REFUSED_OF_PICTURES[name], preset="minatar-breakout")).startswith(f"{name}: only ")


def test_a_game_that_is_not_there_has_a_reason() -> None:
    config = config_of("dqn", {"env": {"id": "MinAtar/Pong-v1"}}, preset="minatar-breakout")
    assert why_not(config).startswith("env.id: unknown environment 'MinAtar/Pong-v1'")
