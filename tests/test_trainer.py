"""What a learner does with a batch, and when a run is over: no socket, no file, no clock."""

from collections.abc import Iterator
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from samples import make_segment

from coop.common.settings.config import ActorSettings, LearnerSettings, NetworkSettings, ReplaySettings, RunConfig
from coop.common.transitions import Batch, Drawn
from coop.common.types import EnvSpec, EpisodeEnd, EpisodeRecord
from coop.learner.agent import Agent
from coop.learner.trainer import Effects, Trainer
from coop.replay.table.table import Table

SPEC = EnvSpec("CartPole-v0", (4,), "float32", 1, 2)
CONFIG = RunConfig(
    total_steps=10_000,
    method="coop",
    learner=LearnerSettings(swap_every=10, publish_every=7),
    network=NetworkSettings(hidden=(8, 8)),
    actor=ActorSettings(epsilon_decay="exponential"),
)


def batches() -> Iterator[Batch]:
    """Draws from a table of 80 transitions; the parameters that acted had version 3."""
    table = Table(SPEC, 100, rng=np.random.default_rng(0))
    for sequence in range(10):
        frames = np.random.default_rng(sequence).standard_normal((9, 4)).astype(np.float32)
        versions, ends = np.full(8, 3), np.arange(8) == 7
        segment = make_segment(SPEC, sequence, 8, frames=frames, param_version=versions, terminated=ends, carried=0)
        table.insert(segment)
    while True:
        yield table.sample(32)


def replace_rewards(batch: Batch, reward: float) -> Batch:
    """The batch with this reward in each transition."""
    return msgspec.structs.replace(batch, rewards=np.full_like(batch.rewards, reward))


def drawn(inserted: int = 200, *returns: float, planned: int = 9_000) -> Drawn:
    """The counters that come with a batch, and episodes of these returns."""
    ends = [EpisodeEnd(0, value, 9, 0.1, 0.2, 0.3, 5) for value in returns]
    records = tuple(EpisodeRecord(inserted - 1, 77, 0, end) for end in ends)
    return Drawn(0, inserted, 80, 20, 5, 0, records, planned, terminal=8)


def train(trainer: Trainer, updates: int) -> list[Effects]:
    """So many updates, one a second."""
    source = batches()
    return [trainer.train(next(source), drawn(100 + number), float(number)) for number in range(updates)]


def test_networks_are_broadcast_at_every_swap_and_every_few_updates() -> None:
    effects = train(Trainer(Agent(CONFIG, SPEC), 0.0), 45)
    broadcasts = [number for number, effect in enumerate(effects, start=1) if effect.broadcast]
    assert broadcasts == [number for number in range(1, 46) if number % 7 == 0 or number % 10 == 0]


def test_priorities_are_the_size_of_the_td_errors() -> None:
    prioritized = replace(CONFIG, replay=ReplaySettings(sampling="prioritized"))
    trainer, reference = Trainer(Agent(prioritized, SPEC), 0.0), Agent(prioritized, SPEC)
    batch = next(batches())
    errors = reference.update(batch).td_errors
    assert errors.min() < 0
    np.testing.assert_array_equal(trainer.train(batch, drawn(), 0.0).priorities, np.abs(errors))
    assert Trainer(Agent(CONFIG, SPEC), 0.0).train(batch, drawn(), 0.0).priorities is None


def test_what_a_gpu_measures_is_read_later_or_where_it_is_due() -> None:
    """At broadcasts, at checkpoints and at a row; in between, two updates wait."""
    learner = replace(CONFIG.learner, swap_every=10_000, publish_every=50)
    config = replace(CONFIG, learner=learner, replay=ReplaySettings(sampling="prioritized"), checkpoint_every=20)
    trainer, reference, source = Trainer(Agent(config, SPEC), 0.0), Agent(config, SPEC), batches()
    trainer.agent.lag = 2
    ids, errors, waiting, left = [], [], [], []
    for _ in range(210):
        batch = next(source)
        waiting.append((batch.ids, np.abs(reference.update(batch).td_errors)))
        effects = trainer.train(batch, drawn(), 0.0)
        read = 0 if effects.ids is None else len(effects.ids) // 32
        left.append(len(waiting) - read)
        for number, error in waiting[:read]:
            ids.append(number)
            errors.append(error)
        del waiting[:read]
        if read:
            np.testing.assert_array_equal(effects.ids, np.concatenate(ids[-read:]))
            np.testing.assert_array_equal(effects.priorities, np.concatenate(errors[-read:]))
        if trainer.checkpoint_due():
            trainer.checkpoint_begun()
    at_once = [update for update, count in enumerate(left, start=1) if not count]
    assert at_once == sorted({*range(20, 211, 20), 50, 100, 150, 200})
    assert set(left) == {0, 1, 2}


def test_what_waits_is_read_before_a_checkpoint() -> None:
    trainer, source = Trainer(Agent(CONFIG, SPEC), 0.0), batches()
    trainer.agent.lag = 1
    trainer.train(next(source), drawn(), 0.0)
    batch = next(source)
    trainer.train(replace_rewards(batch, np.inf), drawn(), 0.0)
    assert trainer.outcome() == ""
    assert not trainer.saveable()
    assert trainer.outcome() == "diverged: TD errors are not finite at update 2"


def test_a_row_of_metrics_every_200_updates() -> None:
    trainer, reference = Trainer(Agent(CONFIG, SPEC), 0.0), Agent(CONFIG, SPEC)
    effects = train(trainer, 400)
    assert [number for number, effect in enumerate(effects, start=1) if effect.metrics] == [200, 400]
    row = effects[399].metrics
    assert row is not None
    assert trainer.metrics is row
    assert Trainer(Agent(CONFIG, SPEC), 0.0).metrics is None
    source = batches()
    drawn_then = [next(source) for _ in range(400)]
    errors = np.concatenate([reference.update(batch).td_errors for batch in drawn_then][200:])
    assert row["td_error"] == pytest.approx(np.abs(errors).mean(), rel=1e-5)
    assert row["loss"] == pytest.approx((0.5 * errors**2).mean(), rel=1e-5)
    assert (row["update"], row["env_step"], row["acting"]) == (400, 499, 1)
    assert row["weight_lag_mean"] == np.arange(201, 401).mean() - 3  # versions between acting and learning
    assert row["updates_per_s"] == row["env_steps_per_s"] == 1.0
    actor = CONFIG.actor
    fallen = (actor.epsilon_start - actor.epsilon_final) * np.exp(-499 / actor.epsilon_steps)
    assert row["epsilon"] == pytest.approx(actor.epsilon_final + fallen)
    assert row["evicted_unsampled"] == 5 / 20
    assert row["replay_size"] == 80
    assert row["terminal_share"] == 8 / 80
    ended = [batch.terminated.mean() for batch in drawn_then[200:]]
    assert row["terminal_drawn_share"] == pytest.approx(np.mean(ended))


def test_q1_and_q2_are_compared_on_the_first_64_states() -> None:
    trainer = Trainer(Agent(CONFIG, SPEC), 0.0)
    source = batches()
    seen = []
    for _ in range(10):
        batch = next(source)
        seen.append(batch.frames[batch.obs_index[:, 0]])
        trainer.train(batch, drawn(), 0.0)
    archive = trainer.telemetry.diagnostics.archive
    assert archive is not None
    np.testing.assert_array_equal(archive.frames[archive.obs_index[:, 0]], np.concatenate(seen)[:64])


def test_episodes_are_numbered_and_keep_what_the_actor_told() -> None:
    trainer = Trainer(Agent(CONFIG, SPEC), 0.0)
    first = trainer.train(next(batches()), drawn(200, 5.0, 7.0), 0.0)
    later = trainer.receive(drawn(210, 9.0))
    rows = [*first.episodes, *later.episodes]
    assert [row.number for row in rows] == [0, 1, 2]
    assert [row.record.end.episode_return for row in rows] == [5.0, 7.0, 9.0]
    assert [row.update for row in rows] == [1, 1, 1]
    assert rows[0].s == trainer.agent.feedback_scale() > 0
    assert trainer.telemetry.return_mean == 7.0
    assert trainer.drawn.inserted == 210
    assert trainer.drawn.episodes == ()


@pytest.mark.parametrize(
    ("config", "drawn", "updates", "outcome"),
    [
        ({}, drawn(10_000, planned=1), 1, "complete"),
        ({}, drawn(10_000, planned=3), 3, "complete"),
        ({}, drawn(10_000, planned=3), 2, ""),
        ({}, drawn(9_999, planned=3), 3, ""),
        ({"total_updates": 1}, drawn(200), 1, "complete: total_updates reached"),
        ({"total_updates": 2}, drawn(200), 2, "complete: total_updates reached"),
        ({"total_updates": 3}, drawn(200), 2, ""),
        ({"total_episodes": 1}, drawn(200, 1.0), 1, "complete: total_episodes reached"),
        ({"total_episodes": 2}, drawn(200, 1.0, 1.0), 1, "complete: total_episodes reached"),
        ({"total_episodes": 3}, drawn(200, 1.0, 1.0), 1, ""),
        ({"target_return": 6.0}, drawn(200, *[5.0, 7.0] * 50), 1, "complete: target_return reached"),
        ({"target_return": 6.1}, drawn(200, *[5.0, 7.0] * 50), 1, ""),
        ({"target_return": 6.0}, drawn(200, *[9.0] * 99), 1, ""),
    ],
)
def test_when_a_run_is_over(config: dict[str, float], drawn: Drawn, updates: int, outcome: str) -> None:
    trainer, source = Trainer(Agent(replace(CONFIG, **config), SPEC), 0.0), batches()  # type: ignore[arg-type]
    for _ in range(updates - 1):
        trainer.train(next(source), msgspec.structs.replace(drawn, episodes=()), 0.0)
    assert trainer.outcome() == ""
    trainer.train(next(source), drawn, 0.0)
    assert trainer.outcome() == outcome
    assert trainer.all_updates_done() == (updates == drawn.planned)


def test_a_new_run_has_neither_diverged_nor_done_all_its_updates() -> None:
    trainer = Trainer(Agent(CONFIG, SPEC), 0.0)
    assert trainer.diverged == trainer.outcome() == ""
    assert not trainer.all_updates_done()  # it is not known yet how many there will be


def test_a_checkpoint_is_due_until_it_is_begun() -> None:
    trainer, source = Trainer(Agent(replace(CONFIG, checkpoint_every=5), SPEC), 0.0), batches()
    due = []
    for update in range(1, 20):
        trainer.train(next(source), drawn(), 0.0)
        due.append(trainer.checkpoint_due())
        if update in (7, 12):  # the one before was still being written at 5 and 6
            trainer.checkpoint_begun()
    assert [update for update, is_due in enumerate(due, start=1) if is_due] == [5, 6, 7, 12, 17, 18, 19]
    never = Trainer(Agent(replace(CONFIG, checkpoint_every=0), SPEC), 0.0)
    train(never, 20)
    assert not never.checkpoint_due()
    never.ask_checkpoint()
    assert not never.checkpoint_due()
    train(never, 1)
    assert never.checkpoint_due()


def test_a_checkpoint_that_is_asked_for_puts_off_none() -> None:
    trainer = Trainer(Agent(replace(CONFIG, checkpoint_every=5), SPEC), 0.0)
    train(trainer, 5)
    trainer.ask_checkpoint()
    assert trainer.checkpoint_due()


@pytest.mark.parametrize("method", ["dqn", "edql", "g-coop", "coop"])
def test_a_run_whose_values_are_no_longer_finite_has_diverged(method: str) -> None:
    config = replace(CONFIG, method=method, checkpoint_every=1, replay=ReplaySettings(sampling="prioritized"))
    trainer = Trainer(Agent(config, SPEC), 0.0)
    for network in trainer.agent.networks:
        network.load(1e30 * network.snapshot())
    effects = train(trainer, 1)[0]
    assert trainer.outcome() == "diverged: TD errors are not finite at update 1"
    assert not effects.broadcast
    assert effects.priorities is None
    assert not trainer.checkpoint_due()
    assert not trainer.saveable()


def test_parameters_that_are_not_finite_are_neither_broadcast_nor_saved() -> None:
    trainer, source = Trainer(Agent(replace(CONFIG, checkpoint_every=6), SPEC), 0.0), batches()
    for _ in range(6):
        trainer.train(next(source), drawn(), 0.0)
    assert trainer.saveable()
    trainer.agent.networks[1].flat[3] = np.inf  # of which the TD errors of this batch know nothing
    assert not trainer.checkpoint_due()
    assert trainer.outcome() == "diverged: parameters are not finite at update 6"
    assert not trainer.train(next(source), drawn(), 0.0).broadcast


def test_an_update_that_leaves_parameters_that_are_not_finite_is_not_broadcast() -> None:
    learner = replace(CONFIG.learner, optimizer="rmsprop", learning_rate=1e38, publish_every=1)
    trainer = Trainer(Agent(replace(CONFIG, learner=learner), SPEC), 0.0)
    effects = train(trainer, 1)[0]  # its TD errors are those of before the step
    assert not effects.broadcast
    assert trainer.outcome() == "diverged: parameters are not finite at update 1"


def test_values_that_are_not_finite_on_the_fixed_states_end_a_run_with_the_row() -> None:
    learner = replace(CONFIG.learner, swap_every=1000, publish_every=1000)
    trainer, source = Trainer(Agent(replace(CONFIG, method="dqn", learner=learner), SPEC), 0.0), batches()
    for _ in range(199):
        assert trainer.train(next(source), drawn(), 0.0).metrics is None
    assert trainer.telemetry.diagnostics.archive is not None
    trainer.telemetry.diagnostics.archive.frames[0] = 1e30
    for network in trainer.agent.networks:
        flat = network.snapshot()
        flat[-18:-2] *= 1e10  # the weights of the output: too much for that state, and for no other
        network.load(flat)
    assert trainer.train(next(source), drawn(), 0.0).metrics is None
    assert trainer.outcome() == "diverged: q_gap is not finite at update 200"


def test_a_loss_that_overflows_ends_a_run_with_the_row_and_without_a_warning() -> None:
    learner = replace(CONFIG.learner, swap_every=1000, publish_every=1000)
    trainer, source = Trainer(Agent(replace(CONFIG, method="dqn", learner=learner), SPEC), 0.0), batches()
    for _ in range(199):
        trainer.train(next(source), drawn(), 0.0)
    for network in trainer.agent.networks:
        flat = network.snapshot()
        flat[-2:] = 1e25  # the biases of the output: errors of about 1e23, whose squares no float32 holds
        network.load(flat)
    assert trainer.train(next(source), drawn(), 0.0).metrics is None
    assert trainer.outcome() == "diverged: loss is not finite at update 200"


def test_values_beyond_what_the_rewards_allow_are_told() -> None:
    gamma = CONFIG.learner.gamma
    trainer, calm = (Trainer(Agent(CONFIG, SPEC), 0.0) for _ in range(2))
    row = train(calm, 200)[-1].metrics
    assert row is not None
    assert row["q_bound"] == pytest.approx(79 / (1 - gamma))  # the largest reward of the table is 79
    assert calm.telemetry.warning(calm.agent) == ""
    for network in trainer.agent.networks:
        flat = network.snapshot()
        flat[-2:] = 2 * row["q_bound"]  # the biases of the output
        network.load(flat)
    train(trainer, 200)
    assert "above" in trainer.telemetry.warning(trainer.agent)


def test_without_discount_there_is_no_bound() -> None:
    undiscounted = replace(CONFIG, learner=replace(CONFIG.learner, gamma=1.0))
    trainer = Trainer(Agent(undiscounted, SPEC), 0.0)
    row = train(trainer, 200)[-1].metrics
    assert row is not None
    assert None not in row.values()  # a packed study can't tell a null from a value that is not there
    assert "q_bound" not in row
    assert trainer.telemetry.warning(trainer.agent) == ""


def test_a_restored_trainer_goes_on() -> None:
    first = Trainer(Agent(replace(CONFIG, checkpoint_every=5), SPEC), 100.0)
    source = batches()
    for _ in range(7):
        first.train(next(source), drawn(300, 4.0), 130.0)
    second = Trainer(Agent(replace(CONFIG, checkpoint_every=5), SPEC), 1_000.0)
    second.load_state(first.state(130.0), 1_000.0)
    assert second.seconds(1_010.0) == 40.0  # 30 before, 10 since
    assert second.drawn == msgspec.structs.replace(drawn(300), episodes=())
    assert not second.checkpoint_due()
    batch = next(source)
    for trainer in (first, second):
        trainer.train(batch, drawn(310, 6.0), 0.0)
    np.testing.assert_array_equal(first.agent.networks[0].snapshot(), second.agent.networks[0].snapshot())
    assert first.telemetry.episodes == second.telemetry.episodes == 8
    assert first.telemetry.return_mean == second.telemetry.return_mean
