"""Action masks: from the environment to the policy, the table, the targets, evaluations and saved policies."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from commands import run_command
from forked import TESTS
from gates import ACTIONS, STATES, Gates, mask_of

import coop
from coop.actors.policy import EpsilonGreedy
from coop.actors.segments import SegmentAssembler
from coop.common.envs.make import env_spec, make_vector_env
from coop.common.errors import BadMessage, CoopError, RunError, UsageError
from coop.common.messaging import wire
from coop.common.messaging.messages.insert import SegmentReader, encode_segment
from coop.common.messaging.messages.sample import BatchReader, encode_batch
from coop.common.networks import network as network_module
from coop.common.networks.masks import LEAST, random_actions
from coop.common.networks.network import FlatNetwork, build_network
from coop.common.settings.environment import EnvSettings
from coop.common.settings.tables import resolve
from coop.common.transitions import Batch, Drawn, Segment
from coop.common.types import EnvSpec
from coop.evaluation.saved import SavedPolicy
from coop.learner.agent import Agent
from coop.learner.diagnostics import Diagnostics
from coop.learner.methods.rule import UpdateRule
from coop.learner.recorded import _WARM_UPS
from coop.lockstep.lockstep import Lockstep
from coop.lockstep.reexecute import reexecute
from coop.records.learner_checkpoints import load_learner
from coop.records.resumption import survey
from coop.records.run_directory import RunDirectory
from coop.replay.table.table import Table

INFO, METHOD = "gates:Gates-v0", "gates:GatesByMethod-v0"
SPEC = EnvSpec(INFO, (STATES,), "float32", 1, ACTIONS, masks=True)
SHORT = {"total_steps": 120, "replay": {"capacity": 50, "learning_starts": 20}, "network": {"hidden": [8]}}


def played(envs: int = 2, steps: int = 40, n_step: int = 1, segment_steps: int = 7) -> list[Segment]:
    """The segments of random play."""
    env, rng = make_vector_env(EnvSettings(id=INFO), envs, 0), np.random.default_rng(0)
    assembler = SegmentAssembler(env.spec, envs, 1, segment_steps, n_step=n_step)
    assembler.begin(env.reset())
    segments = []
    for step in range(steps):
        actions = random_actions(rng, envs, ACTIONS, env.mask)
        segments += assembler.add(actions, env.step(actions), step, {})
    return segments + assembler.flush()


def draws(count: int, size: int = 32, n_step: int = 1) -> list[Batch]:
    """Batches of a table of random play."""
    table = Table(SPEC, 60, rng=np.random.default_rng(0))
    for segment in played(n_step=n_step):
        table.insert(segment)
    return [table.sample(size) for _ in range(count)]


def assert_own_masks(transitions: Segment | Batch) -> None:
    """The masks are those of the observations; of a terminal one, which allows nothing, all."""
    obs, next_obs = (transitions.frames[index[:, -1]] for index in (transitions.obs_index, transitions.next_index))
    np.testing.assert_array_equal(transitions.mask, mask_of(obs))
    expected = mask_of(next_obs) | transitions.terminated[:, None]
    np.testing.assert_array_equal(transitions.next_mask, expected)
    assert transitions.mask is not None
    assert transitions.mask[np.arange(len(transitions)), transitions.actions].all()


@pytest.mark.parametrize("env_id", [INFO, METHOD])
@pytest.mark.parametrize("dtype", ["int8", "bool", "int64", "uint64"])
def test_an_environment_gives_masks_by_info_or_by_a_method(env_id: str, dtype: str) -> None:
    env = make_vector_env(EnvSettings(id=env_id, kwargs={"dtype": dtype}), 2, 0)
    assert env.spec == env_spec(EnvSettings(id=env_id)) == replace_spec(env_id)
    obs = env.reset()
    np.testing.assert_array_equal(env.mask, mask_of(obs))
    rng, ends = np.random.default_rng(0), 0
    for _ in range(12):
        before, steps = env.mask, env.step(random_actions(rng, 2, ACTIONS, env.mask))
        np.testing.assert_array_equal(steps.mask, before)
        np.testing.assert_array_equal(steps.next_mask, mask_of(steps.next_obs) | steps.terminated[:, None])
        np.testing.assert_array_equal(env.mask, mask_of(steps.obs))
        ends += int(steps.restarted.sum())
    assert ends > 3


@pytest.mark.parametrize("env_id", [INFO, METHOD])
def test_masks_are_found_by_the_first_reset_of_play(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """An environment that counts its resets, or takes minutes for each, has no further one."""
    seeds: list[Any] = []
    reset = Gates.reset

    def counted(self: Gates, *, seed: int | None = None, options: Any = None) -> Any:
        seeds.append(seed)
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(Gates, "reset", counted)
    env = make_vector_env(EnvSettings(id=env_id), 2, 7)
    first = env.reset()
    assert env.spec.masks
    assert len(seeds) == len(set(seeds)) == 2
    np.testing.assert_array_equal(env.reset(), first)
    assert seeds[2:] == seeds[:2], "one that is asked for again is done again"


def replace_spec(env_id: str) -> EnvSpec:
    return msgspec.structs.replace(SPEC, env_id=env_id)


@pytest.mark.parametrize("env_id", [INFO, METHOD])
@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("shape", r"gives the action mask int8\[3\] by .*; allowed: bool or int8\[4\], 1 for each allowed action"),
        ("dtype", r"gives the action mask float32\[4\] by"),
        ("values", r"gives the action mask int8\[4\] with values to 2 by"),
        ("none", "gives an action mask that allows no action by"),
    ],
)
def test_wrong_masks_end_with_a_line(env_id: str, wrong: str, words: str) -> None:
    env = make_vector_env(EnvSettings(id=env_id, kwargs={"wrong": wrong}), 1, 0)
    obs = env.reset()
    obs = env.step(mask_of(obs).argmax(1).astype(np.int32)).obs
    action = mask_of(obs).argmax(1).astype(np.int32)
    with pytest.raises(UsageError, match=rf"^env.id: '{env_id}' at step 2 {words}") as refused:
        env.step(action)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("env_id", "wrong", "kind", "words"),
    [
        (INFO, "no", UsageError, r'gives no info\["action_mask"\]; allowed: in each state'),
        (METHOD, "raises", RunError, r"at step 2 raised LookupError: no such gate \(gates.py:\d+\)"),
    ],
)
def test_missing_masks_end_with_a_line(env_id: str, wrong: str, kind: type[CoopError], words: str) -> None:
    env = make_vector_env(EnvSettings(id=env_id, kwargs={"wrong": wrong}), 1, 0)
    obs = env.reset()
    obs = env.step(mask_of(obs).argmax(1).astype(np.int32)).obs
    action = mask_of(obs).argmax(1).astype(np.int32)
    with pytest.raises(kind, match=words):
        env.step(action)


def test_random_actions_are_uniform_among_those_allowed() -> None:
    mask = np.array([[0, 1, 0, 1], [1, 1, 1, 1], [0, 0, 1, 0]], bool)
    drawn = random_actions(np.random.default_rng(0), 6000, 4, mask.repeat(2000, 0)).reshape(3, 2000)
    shares = np.stack([np.bincount(row, minlength=4) for row in drawn]) / 2000
    np.testing.assert_allclose(shares, mask / mask.sum(1, keepdims=True), atol=0.04)


@pytest.mark.parametrize("epsilon", [0.0, 0.5, 1.0])
def test_actors_choose_among_allowed_actions(epsilon: float) -> None:
    network = FlatNetwork(build_network("mlp", SPEC, (8,), 0))
    policy = EpsilonGreedy((network, network), SPEC, np.random.default_rng(0))
    obs = np.eye(STATES, dtype=np.float32).repeat(200, 0)
    mask = mask_of(obs)
    actions = policy.act(obs, epsilon, mask)
    assert mask[np.arange(len(obs)), actions].all()
    if not epsilon:
        np.testing.assert_array_equal(actions, np.where(mask, network.q_values(obs, SPEC), -np.inf).argmax(1))
    assert not mask[np.arange(len(obs)), policy.act(obs, epsilon)].all(), "the masks decide something"


@pytest.mark.parametrize(("n_step", "segment_steps"), [(1, 7), (1, 1), (3, 5), (3, 2)])
def test_masks_are_stored_with_transitions_and_travel_with_them(n_step: int, segment_steps: int) -> None:
    table, read = Table(SPEC, 30, eviction="reservoir", rng=np.random.default_rng(0)), SegmentReader(SPEC)
    for segment in played(n_step=n_step, segment_steps=segment_steps):
        assert_own_masks(segment)
        arrived = read(wire.decode(bytes(encode_segment("run", segment))))
        assert_own_masks(arrived)
        table.insert(arrived)
    other = Table(SPEC, 30, eviction="reservoir", rng=np.random.default_rng(5))
    snapshot = table.snapshot()
    other.load_state(snapshot.meta, {**snapshot.arrays, "frames": snapshot.frames.read()})
    batch = other.sample(64)
    assert_own_masks(batch)
    drawn = Drawn(0, 0, 0, 0, 0, 0, ())
    arrived, _ = BatchReader(SPEC)(wire.decode(bytes(encode_batch("run", batch.frames, batch.columns(), drawn))))
    assert_own_masks(arrived)


def test_messages_have_masks_where_the_environment_has_them() -> None:
    plain = msgspec.structs.replace(SPEC, masks=False)
    segment = played()[0]
    without = msgspec.structs.replace(segment, mask=None, next_mask=None)
    for spec, wrong, words in ((SPEC, without, "missing mask, next_mask"), (plain, segment, "unknown mask, next_mask")):
        with pytest.raises(BadMessage, match=words):
            SegmentReader(spec)(wire.decode(bytes(encode_segment("run", wrong))))
    assert SegmentReader(plain)(wire.decode(bytes(encode_segment("run", without)))).mask is None
    assert "masks" not in msgspec.to_builtins(plain), "as processes of earlier versions have it"
    assert msgspec.convert(msgspec.to_builtins(SPEC), EnvSpec) == SPEC
    narrow = msgspec.structs.replace(segment, mask=segment.mask[:, :3])  # type: ignore[index]
    with pytest.raises(BadMessage, match=r"arrays.mask"):
        SegmentReader(SPEC)(wire.decode(bytes(encode_segment("run", narrow))))


def test_masks_take_memory_only_where_there_are_any() -> None:
    plain = Table(msgspec.structs.replace(SPEC, masks=False), 10, rng=np.random.default_rng(0))
    assert Table(SPEC, 10, rng=np.random.default_rng(0))._columns.row_bytes == plain._columns.row_bytes + 2 * ACTIONS


def use(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let networks of vectors run in a library; else they run in numpy."""
    if library == "torch":
        monkeypatch.setattr(network_module, "_in_numpy", lambda module: None)


def make_agent(method: str = "dqn", capture: Any = None, **tables: dict[str, Any]) -> Agent:
    given = {"network": {"hidden": [8]}, **tables}
    learner = {
        "learning_rate": 0.01,
        "optimizer": "sgd",
        "swap_every": 7,
        "reward_bound": "None",
        **tables.get("learner", {}),
    }
    return Agent(resolve({**given, "learner": learner}, method), SPEC, capture)


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("n_step", [1, 3])
@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_targets_are_of_allowed_actions(
    double: bool, n_step: int, library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(library, monkeypatch)
    agent = make_agent("coop", learner={"double": double})
    assert agent._networks[0].in_numpy == (library == "numpy")
    (batch,) = draws(1, n_step=n_step)
    obs, next_obs = batch.frames[batch.obs_index[:, 0]], batch.frames[batch.next_index[:, 0]]
    q, (online, target) = agent.q_values(obs)[0], agent.q_values(next_obs)
    best = np.where(mask_of(next_obs), online if double else target, -np.inf).argmax(1)
    rows = np.arange(len(batch))
    discount = agent.config.learner.gamma ** batch.span.astype(float) * ~batch.terminated
    expected = q[rows, batch.actions] - (batch.rewards + discount * target[rows, best])
    np.testing.assert_allclose(agent.update(batch).td_errors, expected, rtol=1e-4, atol=1e-5)
    unmasked = msgspec.structs.replace(batch, mask=None, next_mask=None)
    again = make_agent("coop", learner={"double": double})
    assert not np.allclose(again.update(unmasked).td_errors, expected, rtol=1e-4, atol=1e-5), "they decide something"


def plain_call(function: Any, device: torch.device) -> Any:
    for _ in range(_WARM_UPS):
        function()
    return function


@pytest.mark.parametrize("method", ["dqn", "coop"])
def test_recorded_updates_see_masks(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use("torch", monkeypatch)
    tables = {"learner": {"double": True}}
    eager, recorded = make_agent(method, **tables), make_agent(method, plain_call, **tables)
    assert recorded.eager == ""
    for batch in draws(10):
        np.testing.assert_allclose(
            recorded.update(batch).td_errors, eager.update(batch).td_errors, rtol=1e-4, atol=1e-5
        )


class Watching(UpdateRule):
    """Notes what it sees, and has a loss with a slope everywhere."""

    def targets(self, step: Any) -> Any:
        self.seen = {name: getattr(step, name) for name in ("q", "q_next", "target_q", "target_q_next")}
        self.masks = step.mask, step.next_mask
        return step.rewards + step.discounts * step.target_q_next.max(1)

    def loss(self, step: Any, q: Any) -> Any:
        return q.sum()


@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_rules_see_masks_and_actions_not_allowed_get_no_error(library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use(library, monkeypatch)
    coop.register_method(coop.Method("watching", "", rule=Watching))
    agent = make_agent("watching")
    (batch,) = draws(1)
    before = agent.networks[0].snapshot()
    agent.update(batch)
    rule: Any = agent.rule
    for name, mask in (("q", batch.mask), ("target_q", batch.mask), ("q_next", batch.next_mask)):
        np.testing.assert_array_equal(rule.seen[name] == np.float32(LEAST), ~mask)
    for found, expected in zip(rule.masks, (batch.mask, batch.next_mask), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert batch.mask is not None
    bias = agent.networks[0].views(agent.networks[0].snapshot() - before)["out.bias"]
    np.testing.assert_allclose(bias, -0.01 * batch.mask.sum(0), rtol=1e-4)


def test_diagnostics_leave_out_actions_that_are_not_allowed() -> None:
    agent, diagnostics = make_agent("g-coop"), Diagnostics()
    (batch,) = draws(1, 64)
    diagnostics.add(batch)
    row = diagnostics.row(agent)
    obs = batch.frames[batch.obs_index[:, 0]]
    q = np.stack(agent.q_values(obs))
    assert row["q1_mean"] == pytest.approx(q[0][batch.mask].mean(), rel=1e-4)
    assert row["q_abs_mean"] == pytest.approx(np.abs(q[:, batch.mask]).mean(), rel=1e-4)
    assert row["archive_td_error"] == pytest.approx(np.abs(agent.update(batch).td_errors).mean(), rel=1e-4)
    assert 0 <= diagnostics.row(agent)["policy_churn"] <= 1
    assert diagnostics.archive is not None
    other = Diagnostics()
    other.load_state(diagnostics.state())
    np.testing.assert_array_equal(other.archive.mask, batch.mask)  # type: ignore[union-attr]


@pytest.mark.parametrize("method", ["dqn", "stream-q"])
def test_lockstep_trains_with_masks(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    tables = {name: value for name, value in SHORT.items() if name != "replay" or method == "dqn"}
    run = Lockstep(resolve({**tables, "env": {"id": INFO}}, method))
    seen: list[Batch] = []
    train = run.trainer.train
    monkeypatch.setattr(run.trainer, "train", lambda batch, *others: seen.append(batch) or train(batch, *others))
    for _ in range(60):
        list(run.play())
    assert any(batch.terminated.any() for batch in seen)
    for batch in seen:
        assert_own_masks(batch)


@pytest.mark.parametrize("method", ["dqn", "coop", "medqn", "stream-q"])
def test_a_run_never_plays_what_is_not_allowed(method: str, tmp_path: Path) -> None:
    """The environment would raise. In training, evaluations, a resumption, and by the saved policy."""
    config: dict[str, Any] = {**SHORT, "env": {"id": INFO}, "eval_every": 60, "eval_episodes": 3}
    if method == "stream-q":
        config.pop("replay")
    coop.train(run_dir=tmp_path, method=method, **config).wait()
    coop.train(run_dir=tmp_path, method=method, resume=True, **{**config, "total_steps": 180}).wait()
    run = coop.load(tmp_path)
    assert run.summary is not None
    assert (run.summary["exit"], run.summary["env_steps"]) == ("complete", 180)
    assert len(run.evaluations) == 3
    policy = run.policy()
    assert policy.spec == SPEC
    obs = np.eye(STATES, dtype=np.float32)
    mask = mask_of(obs)
    assert mask[np.arange(STATES), policy(obs, mask)].all()
    assert policy(obs[0], mask[0]) == np.where(mask[0], policy.q_values(obs[0]), -np.inf).argmax()
    assert coop.evaluate(policy, 4, epsilon=0.5, at_once=2).returns
    assert coop.evaluate(lambda obs, mask: mask.argmax(1), 4, env=INFO).returns
    if method != "stream-q":
        buffer = run.buffer()
        np.testing.assert_array_equal(buffer.mask, mask_of(buffer.observations))
        assert len(buffer.frame()["next_mask"]) == 50


def test_a_run_whose_masks_have_changed_is_not_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Observations, rewards and ends are the same."""
    config = resolve({**SHORT, "env": {"id": INFO}}, "dqn")
    run = Lockstep(config)
    with RunDirectory(tmp_path, config, log="none") as directory:
        for _ in range(30):
            list(run.play())
        run.save(directory)
    (saved,) = survey(tmp_path, replay=True, load=load_learner).whole
    Lockstep(config).restore(saved)
    mask = Gates._mask
    monkeypatch.setattr(Gates, "_mask", lambda env: mask(env) | (env._state == 4))
    with pytest.raises(RunError, match="showed something else when the run's 30 actions were played again"):
        Lockstep(config).restore(saved)


def test_what_is_no_policy_of_masks_is_refused_in_a_line() -> None:
    network = FlatNetwork(build_network("mlp", SPEC, (8,), 0))
    policy, obs = SavedPolicy(EnvSettings(id=INFO), SPEC, (network,)), np.eye(STATES)[0]
    for mask, words in (
        ([1, 0, 1], r"mask int64\[3\]: gates:Gates-v0 has bool or 0 and 1, \[4\]"),
        ([0.0, 1.0, 1.0, 1.0], r"mask float64\[4\]"),
        ([0, 2, 0, 0], r"mask int64\[4\]"),
        ([0, 0, 0, 0], "mask: allows no action"),
    ):
        with pytest.raises(UsageError, match=words):
            policy(obs, mask)
    with pytest.raises(UsageError, match="must take observations and action masks, which 'gates:Gates-v0' has"):
        coop.evaluate(lambda obs: np.zeros(len(obs), int), 2, env=INFO)
    with pytest.raises(UsageError, match=r"policy: gives [0-3], which the mask of 'gates:Gates-v0''s state"):
        coop.evaluate(lambda obs, mask: (~mask).argmax(1), 2, env=INFO)


def test_a_distributed_run_with_masks(tmp_path: Path) -> None:
    """Actors, replay service and learner; the journal, in which the masks are, gives the same parameters again."""
    flags = ("--env.id", METHOD, "--method", "coop", "--actors", "2", "--total-steps", "900", "--run-dir", tmp_path)
    sizes = ("--network.hidden", "8", "--replay.capacity", "200", "--replay.learning-starts", "50", "--replay.journal")
    done = run_command("coop-local", *flags, *sizes, "--learner.double", cwd=Path(TESTS))
    assert (done.returncode, done.stderr) == (0, "")
    assert reexecute(tmp_path).missing_segments == 0
    buffer = coop.load(tmp_path, allow_import=["gates"]).buffer()
    np.testing.assert_array_equal(buffer.mask, mask_of(buffer.observations))
    assert buffer.mask is not None
    assert buffer.mask[np.arange(len(buffer)), buffer.actions].all()
