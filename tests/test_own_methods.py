"""Methods and policies of a user's own, by "module:name": the examples, what hooks see, and how they are refused."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from commands import run_command
from test_agent import SPEC, batches

import coop
from coop.common.errors import CoopError, JoinError, RunError, UsageError
from coop.common.imports import permit
from coop.common.messaging import wire
from coop.common.messaging.messages.control import JoinReply
from coop.common.networks import network as network_module
from coop.common.settings.tables import resolve
from coop.common.transitions import Batch
from coop.learner.agent import Agent
from coop.learner.methods.own_rule import OwnRule
from coop.learner.methods.rule import UpdateRule
from coop.learner.methods.step import to_host

EXAMPLES = Path(__file__).parents[1] / "examples" / "methods"


@pytest.fixture(autouse=True)
def _examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)


def agent_of(method: str, **tables: Any) -> Agent:
    """An agent with networks that differ, whose optimizer is plain gradient descent."""
    learner = {"optimizer": "sgd", "learning_rate": 0.1, "swap_every": 100, **tables.pop("learner", {})}
    agent = Agent(resolve({"method": method, "network": {"hidden": [8]}, "learner": learner, **tables}), SPEC)
    flat = agent.networks[1].snapshot()
    agent.networks[1].load(flat + 0.2 * np.random.default_rng(1).standard_normal(len(flat), np.float32))
    return agent


def values(agent: Agent, batch: Batch) -> Any:
    """Q of both networks at obs and next_obs: float32 [2, 2, batch, actions]."""
    both = (batch.frames[index].reshape(-1, 4) for index in (batch.obs_index, batch.next_index))
    return np.stack([agent.q_values(obs) for obs in both], axis=1)


def discounts(batch: Batch, gamma: float = 0.99) -> Any:
    return gamma**batch.span * ~batch.terminated


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_examples_are_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) < 40


@pytest.mark.parametrize(
    "settings",
    [
        *({"method": name} for name in ("munchausen:MUNCHAUSEN", "minto:Minto", "minto:MAXMIN", "cql:CQL")),
        *({"eviction": name} for name in ("best_returns:BestReturns", "hashed_coverage:Coverage")),
        *({"sampling": name} for name in ("recency:Combined", "recency:Geometric")),
    ],
    ids=lambda settings: next(iter(settings.values())),
)
def test_examples_train_and_go_on_to_the_byte(settings: dict[str, str], tmp_path: Path) -> None:
    """The second half of a run, from its checkpoint, leaves the parameters of the uninterrupted one."""
    digests = []
    for steps, name in ((160, "whole"), (80, "halves"), (160, "halves")):
        tables = {"replay": {"capacity": 60, "learning_starts": 20, **settings}, "network": {"hidden": [8]}}
        method = tables["replay"].pop("method", "coop")  # type: ignore[attr-defined]
        run = coop.train(
            method=method, total_steps=steps, run_dir=tmp_path / name, resume=name == "halves", log="none",
            actor={"epsilon_steps": 50}, learner={"learning_rate_final": 1.0}, **tables,
        )  # fmt: skip
        assert run.wait()["exit"] == "complete"  # type: ignore[index]
        digests.append([each.snapshot().tobytes() for each in coop.load(tmp_path / name).checkpoint().networks])
    assert digests[0] == digests[2] != digests[1]


def test_munchausen_by_the_paper_s_formula() -> None:
    agent, batch = agent_of("munchausen:MUNCHAUSEN", munchausen={"tau": 0.5, "alpha": 0.8, "low": -0.4}), batches(1)[0]
    q = torch.from_numpy(values(agent, batch)).double()
    log, log_next = (0.5 * torch.log_softmax(q[1, when] / 0.5, 1) for when in (0, 1))
    taken = log.numpy()[np.arange(32), batch.actions]
    assert (taken < -0.4).any()
    assert (taken > -0.4).any()
    soft = ((log_next / 0.5).exp() * (q[1, 1] - log_next)).sum(1).numpy()
    targets = batch.rewards + 0.8 * taken.clip(-0.4, 0) + discounts(batch) * soft
    expected = q[0, 0].numpy()[np.arange(32), batch.actions] - targets
    np.testing.assert_allclose(agent.own_td_errors(batch), expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(agent.update(batch).td_errors, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("method", ["minto:Minto", "minto:MAXMIN"])
def test_minto_takes_the_smaller_value_of_each_action(method: str) -> None:
    agent, batch = agent_of(method), batches(1)[0]
    q = values(agent, batch)
    best = [max(min(one, other) for one, other in zip(*rows, strict=True)) for rows in zip(*q[:, 1], strict=True)]
    assert not np.allclose(best, q[:, 1].max(2).min(0)), "which is not the smaller of both maxima"
    targets = batch.rewards + discounts(batch) * np.array(best)
    expected = q[0, 0][np.arange(32), batch.actions] - targets
    np.testing.assert_allclose(agent.update(batch).td_errors, expected, rtol=1e-4, atol=1e-5)
    assert agent.rule.metrics() == {"online_smaller_share": pytest.approx((q[0, 1] < q[1, 1]).mean())}
    assert agent.config.two_networks == (method == "minto:MAXMIN")


def test_cql_s_gradient_is_autograd_s() -> None:
    """One step of gradient descent on the TD loss and the penalty, both by autograd through the whole network."""
    agent, batch = agent_of("cql:CQL", cql={"weight": 2.0}), batches(1)[0]
    before, q = agent.networks[0].snapshot(), values(agent, batch)
    targets = torch.tensor(batch.rewards + discounts(batch) * q[1, 1].max(1), dtype=torch.float32)
    module = agent.networks[0].module
    for parameter in module.parameters():
        parameter.requires_grad_()
    out = module(torch.tensor(batch.frames[batch.obs_index].reshape(-1, 4)))
    taken = out.gather(1, torch.tensor(batch.actions, dtype=torch.int64)[:, None])[:, 0]
    cost = (0.5 * (taken - targets) ** 2).mean() + 2 * (out.logsumexp(1) - taken).mean()
    slopes = torch.autograd.grad(cost, list(module.parameters()))
    for parameter in module.parameters():
        parameter.requires_grad_(False)
    expected = before - 0.1 * torch.cat([slope.ravel() for slope in slopes]).numpy()
    agent.update(batch)
    np.testing.assert_allclose(agent.networks[0].snapshot(), expected, rtol=1e-4, atol=1e-6)


class Squared(UpdateRule):
    """The default targets and loss, by hooks that see the batch."""

    def targets(self, step: Any) -> Any:
        assert (step.batch.reuse >= 1).all()
        assert (step.batch.ids >= 0).all()
        assert (step.discounts[step.batch.terminated] == 0).all()
        return super().targets(step)

    def loss(self, step: Any, q: torch.Tensor) -> torch.Tensor:
        taken = q.gather(1, step.actions[:, None])[:, 0]
        return (0.5 * step.weights * (taken - step.targets) ** 2).mean()


@pytest.mark.parametrize("learner", [{}, {"double": True}, {"reward_bound": 0.001}], ids=str)
@pytest.mark.parametrize("like", ["dqn", "coop"])
def test_hooks_that_say_the_same_do_the_same(like: str, learner: dict[str, Any], monkeypatch: Any) -> None:
    of = coop.Method("squared", "", rule=Squared, two_networks=like == "coop", error_driven=like == "coop")
    monkeypatch.setattr(sys.modules[__name__], "SQUARED", of, raising=False)
    # Of 8 units, a state may leave one active: how error-driven learning then completes U V^T is a matter of rounding.
    own, plain = (agent_of(name, learner=learner, network={"hidden": [32]}) for name in (f"{__name__}:SQUARED", like))
    for batch in batches(3):
        np.testing.assert_allclose(own.update(batch).td_errors, plain.update(batch).td_errors, rtol=1e-4, atol=1e-6)
    for one, other in zip(own.networks, plain.networks, strict=True):
        np.testing.assert_allclose(one.snapshot(), other.snapshot(), rtol=1e-4, atol=1e-6)


def test_soft_targets_follow_by_hand() -> None:
    agent = agent_of("dqn", learner={"tau": 0.25, "target_update_every": 1})
    before = agent.networks[1].snapshot()
    result = agent.update(batches(1)[0])
    expected = before + 0.25 * (agent.networks[0].snapshot() - before)
    np.testing.assert_allclose(agent.networks[1].snapshot(), expected, rtol=1e-6)
    assert (agent.versions, result.swapped) == ([1, 1], False)
    assert not np.array_equal(agent.networks[0].snapshot(), agent.networks[1].snapshot())


def test_a_method_may_move_its_target_network_and_sees_the_step() -> None:
    class Half(UpdateRule):
        def after_update(self, step: Any) -> None:
            step.target.follow(step.online, 0.5)

    agent = agent_of("dqn")
    agent.rule = Half(agent.config, np.random.default_rng(0))
    before = agent.networks[1].snapshot()
    agent.update(batches(1)[0])
    np.testing.assert_allclose(agent.networks[1].snapshot(), (before + agent.networks[0].snapshot()) / 2, rtol=1e-5)


class Counting(UpdateRule):
    name = "mine"

    def metrics(self) -> dict[str, float]:
        return {self.name: 7.0}


def test_a_method_s_metrics_are_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flags: dict[str, Any] = {
        "method": f"{__name__}:Counting",
        "total_steps": 330,
        "network": {"hidden": [8]},
        "log": "none",
    }
    coop.train(run_dir=tmp_path / "a", **flags).wait()
    assert coop.load(tmp_path / "a").metrics["mine"].tolist() == [7.0]
    monkeypatch.setattr(Counting, "name", "loss")
    with pytest.raises(coop.RunError, match="its metrics can't be called 'loss', as others are"):
        coop.train(run_dir=tmp_path / "b", **flags).wait()


class Sees(UpdateRule):
    """Keeps the steps that its hooks see."""

    def targets(self, step: Any) -> Any:
        self.outer = step
        return super().targets(step)

    def loss(self, step: Any, q: torch.Tensor) -> torch.Tensor:
        self.inner = step
        return q.sum()


def test_costs_see_the_step_in_tensors() -> None:
    agent, (first, second) = agent_of("dqn"), batches(2)
    rule = agent.rule = Sees(agent.config, np.random.default_rng(0))
    for batch in (first, second):
        agent.update(batch)
    outer, inner = rule.outer, rule.inner
    for name in ("online", "target", "batch", "inputs"):
        assert getattr(inner, name) is getattr(outer, name)
    assert inner.batch is second
    assert outer.update == inner.update == 1
    assert outer.mask is outer.next_mask is inner.mask is inner.next_mask is None
    for name in ("actions", "rewards", "discounts", "weights", "targets"):
        np.testing.assert_array_equal(getattr(inner, name).numpy(), getattr(outer, name), strict=True)


@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_td_errors_towards_own_targets_see_the_batch_and_diverge_quietly(
    library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if library == "torch":
        monkeypatch.setattr(network_module, "_in_numpy", lambda module: None)
    agent, (batch,) = agent_of("dqn"), batches(1)
    assert agent.own_td_errors(batch) is None
    rule = agent.rule = Sees(agent.config, np.random.default_rng(0))
    plain = agent.own_td_errors(batch)
    assert plain is not None
    assert rule.outer.batch is batch
    np.testing.assert_allclose(agent.update(batch).td_errors, plain, rtol=1e-6)
    for network in agent.networks:
        network.load(1e38 * network.snapshot())
    diverged = agent.own_td_errors(batch)  # pytest makes an error of every warning
    assert diverged is not None
    assert not np.isfinite(diverged).all()


def test_a_rule_gets_numpy_unless_its_own_class_says_otherwise() -> None:
    class Plain(UpdateRule):
        pass

    class There(UpdateRule):
        on_device = True

    class Below(There):
        pass

    assert [kind.on_device for kind in (UpdateRule, Plain, There, Below)] == [True, False, True, False]
    whole, half = to_host(torch.tensor([1, 2])), to_host(torch.tensor([0.5], dtype=torch.bfloat16))
    assert (whole.dtype, half.dtype) == (np.int64, np.float32)


class Answering(UpdateRule):
    """Gives what a test wants of one of its methods."""

    answers: ClassVar[dict[str, Any]] = {}

    def __getattribute__(self, name: str) -> Any:
        answer = Answering.answers.get(name)
        return object.__getattribute__(self, name) if answer is None else answer


class Costing(Answering):
    def loss(self, step: Any, q: Any) -> Any:
        raise NotImplementedError


def failing(*arguments: Any) -> Any:
    raise SystemExit("no licence")


@pytest.mark.parametrize(
    ("rule", "name", "answer", "kind", "words"),
    [
        (Answering, "bootstrap", lambda values, _: values, UsageError, r": bootstrap gives float32\[32, 2\], must be"),
        (
            Answering,
            "bootstrap",
            lambda values, _: values.max(1).tolist(),
            UsageError,
            ": bootstrap gives list, must be",
        ),
        (
            Answering,
            "bootstrap",
            lambda values, _: values.max(1) * 1j,
            UsageError,
            r": bootstrap gives complex64\[32\]",
        ),
        (Answering, "bootstrap", lambda values, _: values.max(1) > 0, UsageError, r": bootstrap gives bool\[32\]"),
        (
            Answering,
            "bootstrap",
            lambda values, _: torch.zeros(32, dtype=torch.bool),
            UsageError,
            r": bootstrap gives bool\[32\], must be float32\[32\]$",
        ),
        (
            Answering,
            "bootstrap",
            lambda values, _: torch.zeros(32, dtype=torch.complex64),
            UsageError,
            r": bootstrap gives complex64\[32\]",
        ),
        (Answering, "metrics", lambda: {1: 2.0}, UsageError, ": metrics gives the name 1, must be a text"),
        (Answering, "bootstrap", failing, RunError, r" raised SystemExit: no licence \(test_own_methods.py:\d+\)$"),
        (Answering, "metrics", lambda: {"x": "a"}, UsageError, ": metrics gives 'x' as str, must be a number"),
        (Answering, "metrics", list, UsageError, ": metrics gives list, must be a table"),
        (Answering, "state", lambda: {"x": object()}, UsageError, ": state can't be saved"),
        (Answering, "state", lambda: {"x": lambda: 0}, UsageError, ": state can't be saved"),
        (Answering, "state", list, UsageError, ": state gives list, must be a dict"),
        (Costing, "loss", lambda step, q: q.sum(1), UsageError, r": loss gives a tensor of shape \[32\], must be"),
        (Costing, "loss", lambda step, q: q.detach().sum(), UsageError, ": loss gives a tensor that does not depend"),
        (Costing, "loss", lambda step, q: 1.0, UsageError, ": loss gives float, must be a tensor of one"),
    ],
)
def test_what_a_rule_raises_or_gives_wrongly_names_the_method(
    rule: type[Answering], name: str, answer: Any, kind: type[CoopError], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Answering, "answers", {name: answer})
    agent = agent_of(f"test_own_methods:{rule.__name__}")
    run = getattr(agent.rule, name) if name in ("metrics", "state") else partial(agent.update, batches(1)[0])
    with pytest.raises(kind, match=f"^method = 'test_own_methods:{rule.__name__}'{words}"):
        run()


class Unmade(UpdateRule):
    def __init__(self, config: Any, rng: Any) -> None:
        raise ValueError("no licence")


def test_a_rule_is_made_of_the_config_and_the_generator_or_names_the_method() -> None:
    agent = agent_of("test_own_methods:Answering")
    assert (type(agent.rule), agent.rule.config) == (OwnRule, agent.config)
    assert agent.rule.rng is agent._noise
    assert type(agent_of("dqn").rule) is UpdateRule
    with pytest.raises(RunError, match=r"^method = 'test_own_methods:Unmade' raised ValueError: no licence"):
        agent_of("test_own_methods:Unmade")


@pytest.mark.parametrize("convert", [torch.Tensor.double, lambda values: values.double().numpy()])
def test_values_of_a_rule_become_those_of_the_networks_library(convert: Any) -> None:
    class Elsewhere(UpdateRule):
        on_device = True

        def bootstrap(self, next_values: Any, preferred: Any) -> Any:
            return convert(next_values.amax(1))

    agent, values = agent_of("dqn"), torch.rand(4, 2)
    rule: Any = OwnRule(Elsewhere(agent.config, np.random.default_rng(0)), "method = 'elsewhere'")
    torch.testing.assert_close(rule.bootstrap(values, values), values.amax(1))


def test_the_state_of_a_rule_is_a_part_of_the_agent_s(monkeypatch: pytest.MonkeyPatch) -> None:
    state = {"count": 3, "seen": [0.5, "a"], "values": torch.ones(2)}
    monkeypatch.setattr(Answering, "answers", {"state": lambda: state})
    assert agent_of("test_own_methods:Answering").state()["rule"] is state


def test_targets_of_another_shape_are_refused() -> None:
    class Wide(UpdateRule):
        def targets(self, step: Any) -> Any:
            return step.target_q_next

    agent = agent_of("dqn")
    rule: Any = OwnRule(Wide(agent.config, np.random.default_rng(0)), "method = 'wide'")
    agent.rule = rule
    with pytest.raises(UsageError, match=r"^method = 'wide': targets gives float32\[32, 2\], must be float32\[32\]"):
        agent.update(batches(1)[0])


def test_a_role_imports_only_what_its_user_permits(monkeypatch: pytest.MonkeyPatch) -> None:
    """The learner's answer names the module; reading the config would run it."""
    config = resolve({"method": "minto:MAXMIN", "replay": {"eviction": "best_returns:BestReturns"}})
    answer = JoinReply(config, SPEC, "x", 0, [], 1, 0).encode("r")
    monkeypatch.setattr("coop.common.imports._named", set())
    with pytest.raises(JoinError, match="method = 'minto:MAXMIN': this process may not import 'minto'"):
        JoinReply.decode(wire.decode(answer))
    permit(["minto"])
    with pytest.raises(
        JoinError, match=r"replay.eviction = 'best_returns:BestReturns': .* --allow-import best_returns"
    ):
        JoinReply.decode(wire.decode(answer))
    permit(["best_returns"])
    assert JoinReply.decode(wire.decode(answer)).config == config


@pytest.mark.timeout(600)
def test_a_topology_with_a_method_and_a_policy_of_one_s_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(EXAMPLES))
    flags = ("--method", "minto:MAXMIN", "--replay.eviction", "best_returns:BestReturns", "--replay.capacity", "50")
    done = run_command("coop-local", *flags, "--total-steps", "300", "--run-dir", tmp_path / "a", timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (
        "settings: preset cartpole; method: minto:MAXMIN; gamma: 0.95; replay: capacity 50, eviction best_ret"
        in done.stdout
    )
    assert coop.load(tmp_path / "a").summary["exit"] == "complete"  # type: ignore[index]
    assert coop.load(tmp_path / "a").policy().spec == SPEC
