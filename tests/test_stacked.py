"""Stacked runs: gymnasium's physics, the agent's updates, and runs that know nothing of those beside them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control.cartpole import CartPoleEnv

from coop.common.errors import UsageError
from coop.common.settings.config import (
    ActorSettings,
    EdlSettings,
    LearnerSettings,
    NetworkSettings,
    ReplaySettings,
    RunConfig,
)
from coop.common.settings.environment import EnvSettings
from coop.common.transitions import Batch
from coop.common.types import EnvSpec
from coop.learner.agent import Agent
from coop.learner.edl.feedback import feedback_matrices
from coop.studies.stacked import networks
from coop.studies.stacked.cartpole import Chance, bits, keys_of, move, normal
from coop.studies.stacked.networks import Shape
from coop.studies.stacked.settings import Runs, StackSettings, from_config
from coop.studies.stacked.stack import Stack

SPEC = EnvSpec("CartPole-v0", (4,), "float32", 1, 2)
CPU = torch.device("cpu")


def config_of(
    method: str, *, feedback: str = "transform", seed: int = 3, noise: str = "constant", **learner: object
) -> RunConfig:
    settings = {"swap_every": 7, "learning_rate": 1e-3, "double": True, "learning_rate_final": 0.1, **learner}
    return RunConfig(
        method=method,
        seed=seed,
        total_steps=120,
        network=NetworkSettings(hidden=(32, 32, 32)),
        learner=LearnerSettings(**settings),  # type: ignore[arg-type]
        edl=EdlSettings(rate=0.3, decay=0.5, decay_every=30, noise=noise, feedback=feedback),  # type: ignore[arg-type]
        replay=ReplaySettings(capacity=40, learning_starts=20),
        actor=ActorSettings(epsilon_start=0.9, epsilon_final=0.3, epsilon_steps=50),
    )


def test_the_physics_is_gymnasiums() -> None:
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (10_000, 4)) * [2.6, 4, 0.25, 4]
    actions = rng.integers(2, size=10_000)
    moved, fell = move(torch.tensor(states), torch.tensor(actions))
    env = CartPoleEnv()
    env.reset(seed=0)
    for number in range(10_000):
        env.state = states[number]  # type: ignore[attr-defined]
        env.steps_beyond_terminated = None  # type: ignore[attr-defined]
        frame, _, terminated, _, _ = env.step(int(actions[number]))
        np.testing.assert_array_equal(moved[number].float().numpy(), frame)
        assert bool(fell[number]) == terminated
    assert 0.1 < fell.double().mean() < 0.9


class Reference:
    """A run of the product's agent and gymnasium's CartPole with the random numbers of a stack's run."""

    def __init__(self, config: RunConfig) -> None:
        self.config = config
        self.agent = Agent(config, SPEC)
        settings, runs = from_config(config)
        self.draws = Chance(settings, runs, CPU).draws(0, config.total_steps)
        self.state = Chance(settings, runs, CPU).first_states()[0].numpy()
        self.table = np.zeros((config.replay.capacity + 1, 10), np.float32)
        self.length, self.returns = 0, list[int]()

    def play(self, steps: int) -> None:
        env = CartPoleEnv()
        env.reset(seed=0)
        for step in range(steps):
            obs = self.state.astype(np.float32)
            action = int(self.draws.action[step, 0])
            if action < 0:
                action = int(self.agent.networks[self.agent.acting].q_values(obs[None], SPEC)[0].argmax())
            env.state, env.steps_beyond_terminated = self.state, None  # type: ignore[attr-defined]
            frame, _, fell, _, _ = env.step(action)
            self.length += 1
            over = fell or self.length == 200
            terminal = over if self.config.env.time_limit_terminal else fell
            self.table[int(self.draws.row[step, 0])] = [*obs, *frame, action, terminal]
            self.state = np.array(env.state)  # type: ignore[attr-defined]
            if over:
                self.returns.append(self.length)
                self.length, self.state = 0, self.draws.reset[step, 0].numpy()
            if step >= self.config.replay.learning_starts:
                self._update(step)

    def _update(self, step: int) -> None:
        rows = self.table[self.draws.batch[step, 0].numpy()]
        size = len(rows)
        index = np.arange(2 * size, dtype=np.int32)[:, None]
        zeros = np.zeros(size, np.int64)
        self.agent._draw_s = lambda: float(self.draws.s[step, 0])  # type: ignore[method-assign]
        frames = np.concatenate((rows[:, :4], rows[:, 4:8]))
        actions, terminated, ones = rows[:, 8].astype(np.int32), rows[:, 9] > 0, np.ones(size, np.float32)
        columns = (
            index[:size],
            index[size:],
            actions,
            ones,
            terminated,
            zeros,
            np.ones(size, np.uint8),
            ones,
            zeros,
            zeros,
            zeros.astype(np.int32),
        )
        self.agent.update(Batch(frames, *columns))


METHODS, OPTIMIZERS = ("dqn", "edql", "g-coop", "coop"), ("sgd", "rmsprop", "adam")
CASES: list[tuple[str, str, str, dict[str, object]]] = [
    *[(method, "transform", optimizer, {}) for method in METHODS for optimizer in OPTIMIZERS],
    *[("edql", "random", optimizer, {}) for optimizer in ("sgd", "rmsprop")],
    ("coop", "transform", "adam", {"loss": "huber", "double": False}),
    ("dqn", "transform", "adam", {"loss": "mse", "reward_bound": 1.0, "gamma": 0.5, "target_update_every": 5}),
]


@pytest.mark.parametrize(("method", "feedback", "optimizer", "learner"), CASES)
def test_a_run_is_that_of_the_agent(method: str, feedback: str, optimizer: str, learner: dict[str, object]) -> None:
    config = config_of(method, feedback=feedback, optimizer=optimizer, **learner)
    settings, runs = from_config(config)
    reference, stack = Reference(config), Stack(settings, runs)
    size = stack.shape.parameters
    for number in (0, 1):
        torch.testing.assert_close(stack.theta[number, 0, :size], reference.agent.networks[number].flat, rtol=0, atol=0)
    reference.play(60)
    stack.advance(60)
    assert stack.updates == reference.agent.updates == 40
    np.testing.assert_allclose(stack.table[:40].numpy(), reference.table[:40], rtol=1e-5, atol=1e-6)
    for number in (0, 1):
        found, expected = stack.theta[number, 0, :size], reference.agent.networks[number].flat
        moved = float((expected - Stack(settings, runs).theta[number, 0, :size]).norm())
        assert float((found - expected).norm()) < 1e-4 * moved
    assert stack.episodes()[0].returns.tolist() == reference.returns


@pytest.mark.parametrize("changes", [{"noise": "normal"}, {"terminal": True}, {"reservoir": True}])
def test_a_run_with_other_settings_is_that_of_the_agent(changes: dict[str, object]) -> None:
    config = config_of("edql", noise=str(changes.get("noise", "constant")))
    if "terminal" in changes:
        config = replace(config, env=EnvSettings(time_limit_terminal=True))
    if "reservoir" in changes:
        config = replace(config, replay=replace(config.replay, eviction="reservoir"))
    settings, runs = from_config(config)
    reference, stack = Reference(config), Stack(settings, runs)
    reference.play(100)
    stack.advance(100)
    found, expected = stack.theta[0, 0, : stack.shape.parameters], reference.agent.networks[0].flat
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
    assert stack.episodes()[0].returns.tolist() == reference.returns


def test_an_episode_ends_at_the_limit_without_being_terminal() -> None:
    settings = StackSettings(
        total_steps=300, learning_starts=250, epsilon_start=0.0, epsilon_final=0.0, time_limit=6, width=32
    )
    stack = Stack(settings, Runs.of([0, 1, 2], "sgd", 0.0, 0.0))
    stack.advance(40)
    assert all(run.returns.tolist() == [6] * 6 for run in stack.episodes())
    assert not stack.table[:, 9].any()
    rows = stack.table[:40]  # of the first run
    followed = (rows[1:, :4] == rows[:-1, 4:8]).all(1)
    assert (~followed).nonzero()[:, 0].tolist() == [5, 11, 17, 23, 29, 35]


@pytest.mark.parametrize("feedback", ["none", "transform", "random", "noise", "matched", "weight-gradient"])
def test_a_run_does_not_depend_on_those_beside_it(feedback: str) -> None:
    settings = StackSettings("edql", feedback, total_steps=60, hidden=2, width=32, learning_starts=20, swap_every=7)
    seeds, rates = np.array([5, 0, 7, 9]), np.array([1e-3, 1e-2, 2e-3, 1e-3])
    many = Stack(settings, Runs(seeds, rates, np.full(4, 0.1), (("rmsprop", 1), ("adam", 3))))
    alone = Stack(settings, Runs(seeds[2:3], rates[2:3], np.full(1, 0.1), (("adam", 1),)))
    many.advance(60)
    for steps in (1, 19, 30, 10):  # however the steps are cut
        alone.advance(steps)
    for name in ("theta", "mean", "square"):
        assert torch.equal(getattr(many, name)[:, 2], getattr(alone, name)[:, 0])
    assert many.episodes()[2].returns.tolist() == alone.episodes()[0].returns.tolist()
    assert not torch.equal(many.theta[0, 0], many.theta[0, 2])


def _example(rank: int | None = None) -> tuple[Shape, torch.Tensor, networks.StackTape, torch.Tensor]:
    torch.manual_seed(0)
    shape = Shape(2, 32)
    theta = torch.stack([shape.initial(seed, 0) for seed in range(3)])
    if rank is not None:  # rank of the last hidden layer's T: that many active units, for every sample
        weight, bias = shape.views(theta)[1]
        weight.zero_()
        bias.fill_(-1)
        bias[:, 5 : 5 + rank] = 1
    x, error = torch.randn(3, 6, 4), torch.randn(3, 6, 2)
    return shape, theta, networks.forward(shape, theta, x), error


@pytest.mark.parametrize("rank", [None, 2, 1, 0])
def test_null_directions_get_the_singular_value_s(rank: int | None) -> None:
    shape, theta, tape, _ = _example(rank)
    # (U V^T)^T e of both unit errors are the rows of U V^T, which must be orthonormal whatever T's rank.
    ts = networks.transforms(shape, theta, tape)
    rows = []
    for action in (0, 1):
        error = torch.zeros(3, 6, 2)
        error[..., action] = 1
        parts, whites = networks.polar_parts(ts, error)
        rows.append(parts[1])
    gram = torch.einsum("kban,kbcn->kbac", torch.stack(rows, 2), torch.stack(rows, 2))
    torch.testing.assert_close(gram, torch.eye(2).expand(3, 6, 2, 2), rtol=0, atol=1e-5)
    exact = torch.linalg.svdvals(ts[1].double())[..., -1]
    torch.testing.assert_close(whites[1].least, exact, rtol=1e-4, atol=1e-7)
    if rank is None or rank == 2:
        module = torch.nn.Sequential(
            torch.nn.Linear(4, 32), torch.nn.ReLU(), torch.nn.Linear(32, 32), torch.nn.ReLU(), torch.nn.Linear(32, 2)
        )
        for (weight, bias), layer in zip(shape.views(theta), module[::2], strict=True):
            layer.weight.data, layer.bias.data = weight[1], bias[1]
        for name, b in feedback_matrices(module, tape.h[0][1], 1.0).items():
            if name == "2":
                plain = networks.backward(shape, theta, tape, torch.eye(2)[0].expand(3, 6, 2))[1][1]
                torch.testing.assert_close(b[:, 0] - plain, rows[0][1], rtol=1e-3, atol=1e-4)


def test_the_controls_have_transforms_lengths() -> None:
    shape = Shape(2, 32)
    gradients = {}
    for feedback in ("none", "transform", "noise", "matched"):
        settings = StackSettings("edql", feedback, total_steps=60, hidden=2, width=32, learning_starts=20)
        stack = Stack(settings, Runs.of([1, 2], "sgd", 1.0, 0.5))
        with torch.inference_mode():
            draws = stack.chance.draws(0, 21)
            for number in range(21):
                stack.act(draws, number, 0)
            before = stack.theta[0].clone()
            stack.update(draws, 20, 0)
        gradients[feedback] = before - stack.theta[0]
    lengths = {name: shape.sums(value.square()).sqrt() for name, value in gradients.items()}
    torch.testing.assert_close(lengths["matched"], lengths["transform"], rtol=1e-3, atol=1e-6)
    both = shape.sums(gradients["matched"] * gradients["none"])
    torch.testing.assert_close(both, lengths["matched"] * lengths["none"], rtol=1e-3, atol=1e-6)
    noise, added = gradients["noise"] - gradients["none"], gradients["transform"] - gradients["none"]
    ratio = shape.sums(noise.square()).sqrt() / shape.sums(added.square()).sqrt()
    assert ((ratio > 0.7) & (ratio < 1.3)).all()
    cosine = shape.sums(noise * gradients["none"]) / lengths["none"] / shape.sums(noise.square()).sqrt()
    assert (cosine.abs() < 0.35).all()


@pytest.mark.parametrize(("rows", "m", "n"), [(8, 16, 16), (8, 16, 24), (8, 24, 16), (8, 16, 4), (8, 2, 16)])
def test_the_polar_factor_of_a_gradient(rows: int, m: int, n: int) -> None:
    torch.manual_seed(0)
    delta, h = torch.randn(3, rows, m), torch.randn(3, rows, n)
    delta[1, 1] = delta[1, 0]  # rank 7
    factor = networks.polar_of_gradient(delta, h, torch.randn(3, 2 * max(m, n)))
    short = factor if m <= n else factor.mT
    torch.testing.assert_close(short @ short.mT, torch.eye(min(m, n)).expand(3, -1, -1), rtol=0, atol=1e-5)
    u, values, vh = torch.linalg.svd((delta.mT @ h).double(), full_matrices=False)
    for run in range(3):
        rank = int((values[run] > 1e-6 * values[run, 0]).sum())
        right = vh[run, :rank].mT
        torch.testing.assert_close(factor[run].double() @ right, u[run, :, :rank], rtol=0, atol=1e-4)


@pytest.mark.parametrize("m", [4, 16])
@pytest.mark.parametrize("bad", [np.inf, np.nan, 1e30])
def test_a_gradient_that_is_not_finite_is_that_of_its_run_alone(m: int, bad: float) -> None:
    torch.manual_seed(0)
    delta, h, noise = torch.randn(3, 8, m), torch.randn(3, 8, 16), torch.randn(3, 32)
    whole = networks.polar_of_gradient(delta, h, noise)
    delta[1, 2, 3], h[1, 2, 3] = bad, bad  # 1e30: their product is what overflows, in float32
    factor = networks.polar_of_gradient(delta, h, noise)
    torch.testing.assert_close(factor[[0, 2]], whole[[0, 2]], rtol=0, atol=0)
    assert factor[1].isnan().all() or (bad == 1e30 and m == 16 and factor[1].isfinite().all())


def test_a_run_that_diverges_under_weight_gradient_leaves_those_beside_it_alone() -> None:
    settings = StackSettings("edql", "weight-gradient", hidden=1, width=8, total_steps=60, learning_starts=20)

    def played(rate: float) -> Stack:
        stack = Stack(settings, Runs(np.array([0, 1]), np.array([rate, 1e-3]), np.full(2, 0.1), (("sgd", 2),)))
        stack.advance(60)
        return stack

    one, other = played(1e30), played(1e-3)
    assert one.finite().tolist() == [False, True]
    torch.testing.assert_close(one.theta[:, 1], other.theta[:, 1], rtol=0, atol=0)


def test_random_numbers_are_uniform_and_apart() -> None:
    runs = Runs.of(list(range(50)), "adam", 1.0, 1.0)
    words = bits(keys_of(runs, CPU), torch.arange(4000)).double() / 2**32
    counts = torch.histc(words, 64, 0, 1)
    assert float((counts - 3125).square().sum() / 3125) < 120  # chi squared of 63 degrees
    scores = (words - 0.5) * 12**0.5
    assert float((scores[:, 1:] * scores[:, :-1]).mean().abs()) < 0.01
    assert float(torch.corrcoef(scores[:20]).fill_diagonal_(0).abs().max()) < 0.08
    drawn = normal(bits(keys_of(runs, CPU), torch.arange(4000))).double()
    assert abs(float(drawn.mean())) < 0.01
    assert abs(float(drawn.std()) - 1) < 0.01
    assert abs(float(drawn.pow(4).mean()) - 3) < 0.1


def test_reservoir_eviction_keeps_each_transition_as_often() -> None:
    settings = StackSettings(total_steps=400, capacity=50, learning_starts=20, eviction="reservoir")
    rows = Chance(settings, Runs.of(list(range(200)), "sgd", 1.0, 0.0), CPU).draws(0, 400).row.numpy() % 51
    held = np.full((51, 200), -1)
    for step in range(400):
        held[rows[step], np.arange(200)] = step
    kept = np.bincount(held[:50].ravel(), minlength=400)
    assert abs(kept[:200].mean() - 25) < 1
    assert abs(kept[200:].mean() - 25) < 1


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda c: replace(c, method="medqn"), "methods"),
        (lambda c: replace(c, replay=replace(c.replay, ratio=2.0)), "replay.ratio"),
        (lambda c: replace(c, env=EnvSettings(id="CartPole-v1")), "env.id"),
        (lambda c: replace(c, network=NetworkSettings(hidden=(8, 16))), "layers"),
        (lambda c: replace(c, learner=replace(c.learner, batch_size=500)), "batch_size"),
    ],
)
def test_settings_without_a_form_are_refused(change: object, named: str) -> None:
    with pytest.raises(UsageError, match=named):
        from_config(change(config_of("dqn")))  # type: ignore[operator]
