"""Evaluation during a run: what an evaluator plays, what becomes of its results; the training stays the same."""

import csv
import re
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from commands import Command, run_command, wait_for
from samples import await_service
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from coop.common.envs.make import make_vector_env
from coop.common.errors import UsageError
from coop.common.messaging.keys import evaluations_key, stop_key
from coop.common.messaging.messages.answers import Ack
from coop.common.messaging.messages.control import EndOfRun, JoinReply
from coop.common.messaging.messages.evaluate import GIF, Evaluated, EvaluationRow
from coop.common.messaging.transport import Node, Refused
from coop.common.process.console import Console
from coop.common.process.lifecycle import Stop
from coop.common.process.processes import free_endpoint
from coop.common.settings.config import NetworkSettings, RunConfig
from coop.common.settings.environment import EnvSettings
from coop.common.types import EnvSpec
from coop.evaluation.episodes import Evaluator, exploring, play
from coop.evaluation.evaluator import EvaluationPlan, EvaluatorService, Schedule
from coop.learner.agent import Agent
from coop.learner.broadcast import Broadcaster
from coop.learner.evaluations import EvaluationInbox
from coop.lockstep.run import LockstepRun
from coop.records.checkpoints import Manifest
from coop.records.reading import returns_by_step
from coop.records.resumption import Start, Survey, Whole
from coop.records.run_directory import RunDirectory
from coop.records.run_options import base_config
from coop.studies.report.figures import evaluations
from coop.studies.report.packing import pack
from coop.studies.report.study import load_study

COLUMNS = "env_step,update,network,episodes,return_mean,return_sd,epsilon,seconds"
SPEC = EnvSpec("CartPole-v0", (4,), "float32", 1, 2)
RESULT = EvaluationRow(500, 300, 1, 10, 21.5, 3.25, 0.0, 1.5)


def rows(folder: Path) -> list[dict[str, str]]:
    text = (folder / "evaluations.csv").read_text()
    assert text.splitlines()[0] == COLUMNS
    return list(csv.DictReader(text.splitlines()))


def without_seconds(folder: Path) -> list[dict[str, str]]:
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows(folder)]


@pytest.mark.parametrize(("episodes", "left", "right"), [(4, 2, 2), (3, 2, 1)])
def test_short_episodes_do_not_crowd_out_long_ones(episodes: int, left: int, right: int) -> None:
    """The first emulator walks to the left, for 50 steps and nothing; the other one reaches the end within 5."""
    env = make_vector_env(EnvSettings(id="corridor:test/Corridor-v0"), 2, 0)
    returns = play(env, lambda obs: np.array([0, 1]), episodes)
    env.close()
    assert sorted(returns) == [0.0] * left + [1.0] * right


def test_epsilon_is_the_share_of_random_actions() -> None:
    spec = EnvSpec("test", (4,), "float32", 1, 5)
    act = exploring(lambda obs: np.zeros(len(obs), np.int64), 0.3, spec, np.random.default_rng(0))
    actions = act(np.zeros((10_000, 4)))
    assert np.mean(actions != 0) == pytest.approx(0.3 * 4 / 5, abs=0.02)


def test_an_evaluation_can_be_repeated_and_abandoned() -> None:
    config = replace(base_config([]), eval_episodes=6)
    env = make_vector_env(config.env, 1, 0)
    network = Agent(config, env.spec).networks[1]
    env.close()
    evaluator = Evaluator(config, lambda: False)
    first, again, other = (evaluator.evaluate(network, 2, 7, step) for step in (100, 100, 200))
    assert first is not None
    assert again is not None
    assert other is not None
    assert (first.env_step, first.update, first.network, first.episodes, first.epsilon) == (100, 7, 2, 6, 0)
    assert msgspec.structs.replace(again, seconds=first.seconds) == first
    assert other.return_mean != first.return_mean, "another step has other starts"
    assert Evaluator(config, lambda: True).evaluate(network, 2, 7, 100) is None


def test_a_schedule_by_steps_and_one_by_seconds() -> None:
    steps = Schedule(None, 100)
    asked = [(0, 0), (50, 99), (52, 101), (60, 130), (120, 305), (121, 310), (180, 400)]
    begun = []
    for progress in asked:
        if steps.due(progress, 0.0):
            steps.begun(progress, 0.0)
            begun.append(progress[1])
    assert begun == [101, 305, 400]
    seconds = Schedule(60.0, 0)
    assert seconds.due((0, 0), 5.0)
    seconds.begun((0, 0), 5.0)
    assert not seconds.due((9, 9), 64.0)
    assert seconds.due((9, 9), 65.0)
    assert not seconds.due((0, 9), 65.0), "these networks have been evaluated"
    never = Schedule(None, 0)
    never.rush()
    assert not never.due((10**9, 10**9), 1e9)
    steps.rush()
    assert [steps.due(progress, 0.0) for progress in ((180, 400), (181, 401))] == [False, True]


class StopsAfter(Stop):
    """A stop at the given number of looks at it."""

    def __init__(self, looks: int) -> None:
        super().__init__()
        self._left = looks

    def is_set(self) -> bool:
        self._left -= 1
        if self._left < 0:
            self.set("interrupted")
        return super().is_set()


def lockstep(config: RunConfig, folder: Path, stop: Stop, *, resume: bool = False) -> str:
    with closing(LockstepRun(config, folder, "test", Start(resume))) as run:
        return run.play(stop).exit


def test_lockstep_runs_are_the_same_with_evaluations_and_through_stops(tmp_path: Path) -> None:
    config = base_config(["--total-steps", "300"])
    env = replace(config.env, max_episode_steps=40)
    config = replace(config, env=env, checkpoint_every=70, network=NetworkSettings(hidden=(8,)))
    evaluating = replace(config, eval_every=50, eval_episodes=3)
    assert lockstep(config, tmp_path / "without", Stop()) == "complete"
    assert lockstep(evaluating, tmp_path / "whole", Stop()) == "complete"
    stops = 0
    while lockstep(evaluating, tmp_path / "torn", StopsAfter(170), resume=stops > 0) == "interrupted":
        stops += 1
    assert stops > 1
    episodes = [(tmp_path / name / "episodes.csv").read_bytes() for name in ("without", "whole", "torn")]
    assert episodes[0] == episodes[1] == episodes[2]
    assert [int(row["env_step"]) for row in rows(tmp_path / "whole")] == list(range(50, 301, 50))
    assert {row["network"] for row in rows(tmp_path / "whole")} == {"1", "2"}
    assert without_seconds(tmp_path / "torn") == without_seconds(tmp_path / "whole")
    assert rows(tmp_path / "without") == []

    pack(tmp_path, tmp_path / "packed.parquet")
    for source in (tmp_path, tmp_path / "packed.parquet"):
        (panel,) = evaluations(load_study(source)).panels
        (line,) = panel.lines
        assert line.x.tolist() == list(range(50, 301, 50))
        means = [float(row["return_mean"]) for row in rows(tmp_path / "whole")]
        assert line.y.value.tolist() == pytest.approx(means), "of two runs that are the same"


def test_films_of_a_lockstep_run(tmp_path: Path) -> None:
    config = base_config(["--preset", "catch", "--method", "dqn", "--total-steps", "300"])
    small = NetworkSettings(hidden=(8,))
    config = replace(config, actor=replace(config.actor, num_envs=1), network=small, video_every=150)
    assert lockstep(config, tmp_path / "run", Stop()) == "complete"
    images = EventAccumulator(str(tmp_path / "run" / "tb")).Reload().Images("eval/video")
    assert [(image.step, image.width, image.height) for image in images] == [(150, 252, 252), (300, 252, 252)]
    for image in images:
        assert (tmp_path / "run" / "videos" / f"{image.step}.gif").read_bytes() == image.encoded_image_string


@pytest.mark.parametrize("name", ["coop-local", "coop-lockstep"])
def test_what_can_t_be_filmed_is_refused_before_the_run_starts(name: str, tmp_path: Path) -> None:
    flags = ("--env.id", "corridor:test/Corridor-v0", "--video-every", "9", "--run-dir", tmp_path / "run")
    done = run_command(name, *flags, cwd=Path(__file__).parent)
    assert (done.returncode, done.stdout) == (2, "")
    why = "has no pictures to film: its metadata['render_modes'] has no 'rgb_array'"
    assert done.stderr == f"{name}: error: video_every: env.id: 'corridor:test/Corridor-v0' {why}\n"
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_keeps_the_lines_up_to_its_checkpoint(tmp_path: Path) -> None:
    config = base_config([])
    with RunDirectory(tmp_path, config) as directory:
        sealed = directory.records()
        for step in (100, 200, 300):
            directory.evaluation(msgspec.structs.replace(RESULT, env_step=step))
        assert directory.evaluated == 300
    with (tmp_path / "evaluations.csv").open("a") as file:
        file.write("150,2,1,10,1,1,0,1")  # torn by a kill, in its last number
    before = (tmp_path / "evaluations.csv").open()
    found = Survey(tmp_path, (Whole(tmp_path, Manifest(5, 7, {}, sealed)),))
    with RunDirectory(tmp_path, config, found, 7, 200) as directory:
        assert directory.evaluated == 200
        with before:
            assert before.read().count("\n") == 4, "a kill while the file is cut back loses no line"
        directory.evaluation(msgspec.structs.replace(RESULT, env_step=250, return_mean=1234567.25))
    assert [row["env_step"] for row in rows(tmp_path)] == ["100", "200", "250"]
    assert rows(tmp_path)[-1]["return_mean"] == "1234567.25"
    board = EventAccumulator(str(tmp_path / "tb")).Reload()
    assert [event.step for event in board.Scalars("eval/return_mean")][-1] == 250
    with RunDirectory(tmp_path, config):
        pass
    assert rows(tmp_path) == []


def test_the_curve_is_of_the_play_with_the_least_randomness(tmp_path: Path) -> None:
    with RunDirectory(tmp_path, base_config([])) as directory:
        for step, epsilon, mean in ((300, 0.0, 3.0), (100, 0.0, 1.0), (200, 0.5, 9.0), (200, 0.0, 2.0)):
            result = msgspec.structs.replace(RESULT, env_step=step, epsilon=epsilon, return_mean=mean)
            directory.evaluation(result)
    assert returns_by_step((tmp_path / "evaluations.csv").read_text()).tolist() == [[100, 200, 300], [1, 2, 3]]
    assert returns_by_step(COLUMNS).shape == (2, 0)


@pytest.fixture
def inbox(nodes: tuple[Node, Node]) -> Iterator[tuple[EvaluationInbox, Node]]:
    """The inbox of a learner that has done 1,000 steps, and an evaluator's node."""
    learner, evaluator = nodes
    taken = EvaluationInbox(learner, lambda: 1000)
    await_service(evaluator, evaluations_key(evaluator))
    yield taken, evaluator
    assert learner.faults.count == 0


def test_a_result_is_taken_once(inbox: tuple[EvaluationInbox, Node]) -> None:
    taken, node = inbox
    later = msgspec.structs.replace(RESULT, env_step=1000)
    for sent in (Evaluated(5, 0, RESULT), Evaluated(5, 0, RESULT), Evaluated(6, 0, later), Evaluated(5, 1, later)):
        answer = node.ask(evaluations_key(node), sent.encode(node.run))
        assert Ack.decode(answer).inserted == 1000
    assert list(taken.take()) == [RESULT, later, later]
    assert list(taken.take()) == []


def test_a_result_of_a_future_that_is_gone_is_refused(inbox: tuple[EvaluationInbox, Node]) -> None:
    taken, node = inbox
    ahead = Evaluated(5, 0, msgspec.structs.replace(RESULT, env_step=1001))
    with pytest.raises(Refused, match="an evaluation after 1,001 steps; this run has done 1,000"):
        node.ask(evaluations_key(node), ahead.encode(node.run))
    assert list(taken.take()) == []


@pytest.mark.timeout(600)  # on a busy machine
def test_evaluators_join_a_run_and_evaluate_its_final_networks(tmp_path: Path) -> None:
    endpoint, folder = free_endpoint(), tmp_path / "run"
    flags = ("--total-steps", "500", "--eval-every", "200", "--eval-episodes", "2", "--run-dir", str(folder))
    flags += ("--method", "dqn", "--env.id", "coop/Catch-v0", "--network.kind", "mlp")
    flags += ("--network.hidden", "8", "--video-every", "200")
    mine = ("--connect", endpoint, "--every", "0.5", "--episodes", "3", "--epsilon", "0.5", "--envs", "2")
    with (
        Command("coop-eval", "--run", "coop", *mine, "--join-timeout", "500") as second,
        Command("coop-local", "--listen", endpoint, *flags) as local,
    ):
        out, err = local.communicate(timeout=500)
        printed, wrong = second.communicate(timeout=80)
    assert (local.returncode, err, second.returncode, wrong) == (0, "", 0, "")
    last = re.search(r"complete: ([\d,]+) steps, ([\d,]+) updates", out)
    assert last is not None
    end = [int(number.replace(",", "")) for number in last.groups()]
    for epsilon, episodes in (("0", "2"), ("0.5", "3")):
        found = [row for row in rows(folder) if row["epsilon"] == epsilon]
        assert {row["episodes"] for row in found} == {episodes}
        steps, updates = ([int(row[name]) for row in found] for name in ("env_step", "update"))
        assert steps == sorted(steps)
        assert updates == sorted(set(updates)), "no networks twice"
        assert updates[-1] == end[1]
        assert steps[-1] <= end[0]  # the last update may come before the last step
    assert f"3 episodes after {steps[-1]:,} steps" in printed
    videos = list((folder / "videos").iterdir())
    assert videos
    assert all(video.read_bytes().startswith(GIF) for video in videos)
    images = EventAccumulator(str(folder / "tb")).Reload().Images("eval/video")
    assert {f"{image.step}.gif" for image in images} == {video.name for video in videos}


def service(nodes: tuple[Node, Node], stop: Stop, plan: EvaluationPlan) -> tuple[Agent, EvaluatorService]:
    """A learner's agent, and an evaluator that has joined its run."""
    config = RunConfig(method="coop", network=NetworkSettings(hidden=(8,)))
    agent = Agent(config, SPEC)
    reply = JoinReply(config, SPEC, agent.networks[0].layout_digest(), 0, [], 5, 0)
    return agent, EvaluatorService(nodes[1], stop, reply, (), plan, 7, Console())


def test_an_evaluator_follows_a_learner_to_its_end(nodes: tuple[Node, Node]) -> None:
    learner, evaluator = nodes
    stop = Stop()
    evaluator.follow_stop(stop)
    agent, evaluations = service(nodes, stop, EvaluationPlan(steps=100, episodes=2))
    broadcaster, inbox = Broadcaster(learner, agent), EvaluationInbox(learner, lambda: 1000)
    taken: list[EvaluationRow] = []

    def learn(update: int, env_step: int) -> None:
        agent.acting, agent.updates = update % 2, update
        agent.versions[agent.acting] = update
        broadcaster.publish(env_step, wait=True)

    def taken_all(count: int) -> bool:
        taken.extend(result for result in inbox.take() if isinstance(result, EvaluationRow))
        return len(taken) >= count

    with ThreadPoolExecutor() as threads, ExitStack() as end:
        end.callback(stop.set, "interrupted")  # also where an assertion fails
        playing = threads.submit(evaluations.run)
        learn(1, 99)
        time.sleep(0.3)
        learn(5, 150)
        wait_for("an evaluation", lambda: taken_all(1))
        learn(6, 199)
        time.sleep(0.3)
        learn(8, 333)
        wait_for("the next one", lambda: taken_all(2))
        learn(9, 390)  # the final networks
        learner.announce(stop_key(learner), EndOfRun.because("complete: total_updates reached").encode(learner.run))
        wait_for("the last one", lambda: taken_all(3))
        playing.result(20)
    assert [(one.env_step, one.update, one.network) for one in taken] == [(150, 5, 2), (333, 8, 1), (390, 9, 2)]
    assert {one.episodes for one in taken} == {2}
    assert list(inbox.take()) == []


def test_an_evaluator_of_an_interrupted_run_stops_at_once(nodes: tuple[Node, Node]) -> None:
    stop = Stop()
    agent, evaluations = service(nodes, stop, EvaluationPlan(seconds=0.0, episodes=100_000))
    Broadcaster(nodes[0], agent)
    inbox = EvaluationInbox(nodes[0], lambda: 1000)
    with ThreadPoolExecutor() as threads, ExitStack() as end:
        end.callback(stop.set, "interrupted")  # also where an assertion fails
        playing = threads.submit(evaluations.run)
        time.sleep(1)
        stop.set("interrupted")
        playing.result(20)
    assert list(inbox.take()) == []


def test_an_evaluator_asks_for_the_final_networks_until_it_has_them(nodes: tuple[Node, Node]) -> None:
    stop = Stop()
    agent, evaluations = service(nodes, stop, EvaluationPlan(steps=100, episodes=2))
    inbox = EvaluationInbox(nodes[0], lambda: 1000)
    stop.set("complete: total_updates reached")
    with ThreadPoolExecutor() as threads:
        playing = threads.submit(evaluations.run)
        time.sleep(0.5)
        Broadcaster(nodes[0], agent, 390)
        playing.result(20)
    assert [one.env_step for one in inbox.take() if isinstance(one, EvaluationRow)] == [390]


def test_an_evaluator_needs_to_know_how_often(nodes: tuple[Node, Node]) -> None:
    with pytest.raises(UsageError, match="--every: needed, as the run has no eval_every"):
        service(nodes, Stop(), EvaluationPlan())
