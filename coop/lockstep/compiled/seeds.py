"""Lockstep runs that differ in their seeds, side by side in one process, each to the bit as by itself.

    runs = [Lockstep(replace(config, seed=seed)) for seed in range(30)]
    seeds = Seeds(runs)
    while seeds.step < config.total_steps:
        for block in seeds.play(200): ...
    seeds.save_into(0)         # now runs[0] is where its seed is, for Lockstep.save

What chance decides depends on no network, so it is drawn for a block of steps ahead, from the runs' own generators.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from coop.common.numbers import METRICS_EVERY, generator_state, set_generator_state
from coop.common.types import Array, EpisodeEnd, EpisodeRecord, EpisodeRow
from coop.learner.agent import Agent
from coop.learner.diagnostics import ARCHIVED
from coop.lockstep.compiled.carts import Carts, cart_of
from coop.lockstep.compiled.games import Games
from coop.lockstep.compiled.passes import Networks
from coop.lockstep.compiled.pictures import PictureNetworks
from coop.lockstep.compiled.step_queue import PlayedStep, StepQueue
from coop.lockstep.compiled.tables import Packing, Tables
from coop.lockstep.lockstep import Lockstep
from coop.lockstep.memory import TableMemory

Ints = NDArray[np.int64]

MOST = 400  # steps of a block


@dataclass(frozen=True)
class PlayedBlock:
    """What a block of steps tells of one run: rows for episodes.csv and metrics.jsonl, in order.

    outcome: why the run is over before all its steps; empty if it is not.
    """

    run: Lockstep
    episodes: Sequence[EpisodeRow]
    metrics: Sequence[dict[str, Any]]
    outcome: str


@dataclass(frozen=True)
class _Block:
    """What chance decides for n steps after the first `step`.

    cut, due: whether a segment ends at a step, and how many updates follow it, m in all. rows: int64 [n, K], where a
    step's transition goes, -1: nowhere. batch: int64 [m, K, batch]. action: int64 [n, K], -1: the greedy one. s:
    float64 [m, K], scales: of s. epsilon: before each step. generators: of each run, their states before.
    """

    step: int
    cut: list[bool]
    due: list[int]
    rows: Ints
    batch: Ints
    action: Ints
    s: NDArray[np.float64]
    scales: list[float]
    epsilon: list[float]
    generators: list[tuple[Any, ...]]


class Seeds:
    """Runs of one config but for their seeds, all at the same step, of which the last one ended a segment.

    Args:
        runs: which are not to be played otherwise meanwhile. player: index of the network that always acts, 0 or 1;
            None: the one that is trained, as in Algorithm 1.

    Attributes:
        runs: those that are not over. step: environment steps done, of each.
    """

    def __init__(self, runs: Sequence[Lockstep], player: int | None = None) -> None:
        self.runs, self._player, self.config = list(runs), player, runs[0].config
        self._agents = [run.agent for run in runs if isinstance(run.agent, Agent)]
        agent, replay = self._agents[0], self.config.replay
        self.step, self.updates, self._role, self._versions = runs[0].step, agent.updates, agent.acting, agent.versions
        memories = [run.memory for run in runs]
        tables = [memory for memory in memories if isinstance(memory, TableMemory)]
        self._tables, self._due = Tables.of(tables, self.config), tables[0].due
        self._games: Carts | Games
        self._nets: Networks | PictureNetworks
        self._games, self._nets = _parts(runs, self._agents, self._tables.packing)
        self._queue, self._outcomes = StepQueue(replay.n_step, self.config.learner.gamma), [""] * len(self.runs)
        self._ahead = replay.n_step == 1  # or the ends of episodes decide what a table holds

    def play(self, most: int) -> list[PlayedBlock]:
        """Play some steps, at least 1 and about `most`, to the end of a segment; those runs that are over are dropped.

        A row of metrics, or a due checkpoint, ends a block.
        """
        block = self._drawn(self._length(most))
        episodes: list[list[EpisodeRow]] = [[] for _ in self.runs]
        metrics: list[list[dict[str, Any]]] = [[] for _ in self.runs]
        with np.errstate(all="ignore"), torch.inference_mode():
            self._play(block, episodes, metrics)
        played = [PlayedBlock(*each) for each in zip(self.runs, episodes, metrics, self._outcomes, strict=True)]
        alive = np.array([k for k, outcome in enumerate(self._outcomes) if not outcome], np.intp)
        if len(alive) < len(self.runs):
            self._keep(alive)
        return played

    def _keep(self, runs: NDArray[np.intp]) -> None:
        self.runs, self._agents = [self.runs[k] for k in runs], [self._agents[k] for k in runs]
        self._outcomes = [""] * len(self.runs)
        if self.runs:
            kept = self._games.kept(runs), self._tables.kept(runs), self._nets.kept(runs)
            self._games, self._tables, self._nets = kept

    def _length(self, most: int) -> int:
        """Steps of the next block."""
        saved = min(run.trainer._next_checkpoint for run in self.runs)
        step, waiting, last = self.step, 0, self.step + min(most, MOST)
        while True:
            step += 1
            waiting = (waiting + 1) % self.config.actor.segment_steps
            before, updates = self._due(step - 1), self._due(step)
            waiting *= updates == before
            ends = before < saved <= updates or updates // METRICS_EVERY > before // METRICS_EVERY
            if step == self.config.total_steps or (not waiting and (ends or step >= last)):
                return step - self.step

    def _drawn(self, count: int) -> _Block:
        """Draw what chance decides for some steps, in the order in which the runs would."""
        config, agent = self.config, self._agents[0]
        steps = range(self.step + 1, self.step + count + 1)
        due = [self._due(step) - self._due(step - 1) for step in steps]
        cut, waiting = [], 0
        for one in due:
            waiting += 1
            cut.append(one > 0 or waiting == config.actor.segment_steps)
            waiting *= not cut[-1]
        epsilon = [agent.epsilon(step - 1) for step in steps]
        runs, size, updates = len(self.runs), config.learner.batch_size, sum(due)
        rows, action = np.full((count, runs), -1), np.full((count, runs), -1)
        batch, s = np.zeros((updates, runs, size), np.int64), np.zeros((updates, runs))
        generators = [tuple(map(generator_state, self._generators(k))) for k in range(runs)]
        block = _Block(self.step, cut, due, rows, batch, action, s, self._scales(updates), epsilon, generators)
        for k in range(runs):
            self._draw(k, block, count)
        return block

    def _generators(self, k: int) -> list[np.random.Generator]:
        """Of run k: those of which numbers are drawn ahead, for its actions, for s and for its table."""
        noise = [self._agents[k]._noise] if self.config.edl.noise == "normal" else []
        return [self.runs[k]._policy_rng, *noise, *([self._tables.rngs[k]] if self._ahead else [])]

    def _draw(self, k: int, block: _Block, count: int) -> None:
        """Draw what chance decides for the first `count` steps of a block of run k."""
        config, due, first, done = self.config, block.due[:count], 0, 0
        policy, noise = self.runs[k]._policy_rng, self._agents[k]._noise
        # From a full table that draws for nothing else, as many numbers are the same at once.
        together = self._ahead and config.replay.eviction == "fifo" and block.step >= config.replay.capacity
        if together:
            block.batch[: sum(due), k] = self._tables.drawn(k, block.step, sum(due))
        for place, updates in enumerate(due):
            if policy.random() < block.epsilon[place]:
                block.action[place, k] = policy.integers(self._agents[k].spec.num_actions, size=1, dtype=np.int32)[0]
            if block.cut[place] and self._ahead:
                block.rows[first : place + 1, k] = self._tables.rows(k, block.step + first, place + 1 - first)
                first = place + 1
            if updates and self._ahead and not together:
                block.batch[done : done + updates, k] = self._tables.drawn(k, block.step + place + 1, updates)
            for number in range(done, done + updates):
                normal = config.edl.noise == "normal" and block.scales[number]
                block.s[number, k] = block.scales[number] * (float(noise.standard_normal()) if normal else 1.0)
            done += updates

    def _scales(self, count: int) -> list[float]:
        """The scale of s in each of the next updates."""
        return [self._agents[0].feedback_scale_at(update) for update in range(self.updates, self.updates + count)]

    def _play(self, block: _Block, episodes: list[list[EpisodeRow]], metrics: list[list[dict[str, Any]]]) -> None:
        games, nets, everyone = self._games, self._nets, slice(0, len(self.runs))
        count, size, held = len(block.due), self.config.learner.batch_size, self._tables.packing
        whole = count, len(self.runs)
        reached, rewards = np.empty((*whole, held.width), held.dtype), np.empty(whole, np.float32)
        raw_rewards, terminated, over = np.empty(whole), np.empty(whole, np.bool_), np.empty(len(self.runs), np.bool_)
        restarts: list[list[tuple[int, Array]]] = [[] for _ in self.runs]
        actions = np.empty(whole, np.int64)
        answers = actions, reached, raw_rewards, terminated
        self._errors = np.zeros((sum(block.due), len(self.runs), size), np.float32)
        self._seen = np.zeros((sum(block.due), len(self.runs), 5, size), np.int64)
        self._told = done = 0
        for place in range(count):
            player = self._role if self._player is None else self._player
            obs, next_obs, action, terminal = games.obs, reached[place], actions[place], terminated[place]
            values = nets.values(player, everyone, obs, block.action[place])
            some_over = games.push(
                values, block.action[place], action, next_obs, rewards[place], raw_rewards[place], terminal, over
            )
            self.step += 1
            ended = self._ended(over, next_obs, block.epsilon[place]) if some_over else []
            self._queue.add(PlayedStep(obs, next_obs, action, rewards[place], terminal, over.copy(), self.updates))
            for k, _ in ended:
                games.restart(k)
                restarts[k].append((place, games.obs[k]))
            if block.cut[place]:
                self._queue.insert(self._tables, block.rows[: place + 1])
            updates = block.due[place]
            if updates and not self._ahead:
                block.batch[done : done + updates, 0] = self._tables.drawn(0, self._tables.inserted, updates)
            for _ in range(updates):
                self._update(block, done)
                done += 1
                if self.updates % METRICS_EVERY == 0:
                    self._rows(done, metrics)
            self._mark_diverged()
            self._record(ended, episodes)
            counted = updates and self.config.total_updates
            for k in self._reached(self._going() if counted else [k for k, _ in ended]):
                self._draw_again(k, block, place + 1)
                self._follow(k, place + 1, answers, restarts[k])
                self.save_into(k)
            if all(self._outcomes):
                return
        for k in self._going():
            self._follow(k, count, answers, restarts[k])
        self._push(done)

    def _ended(self, over: NDArray[np.bool_], obs: NDArray[np.float32], epsilon: float) -> list[tuple[int, EpisodeEnd]]:
        """The episodes that a step has ended, by run."""
        found = []
        for k in np.flatnonzero(over).tolist():
            run, greedy = slice(k, k + 1), np.array([-1])
            means = np.array([float(self._nets.values(role, run, obs[run], greedy).mean()) for role in (0, 1)])
            q1, q2 = np.nan_to_num(means).tolist()
            total, length = float(self._games.returns[k]), int(self._games.lengths[k])
            found.append((k, EpisodeEnd(0, total, length, epsilon, q1, q2, self.updates)))
        return found

    def _update(self, block: _Block, number: int) -> None:
        """Do update `number` of the block in every run; change roles if it is time."""
        nets, role, finite = self._nets, self._role, True
        rate = self._agents[self._going()[0]]._learning_rate()
        for start in range(0, len(self.runs), nets.block):
            runs = slice(start, min(start + nets.block, len(self.runs)))
            given, seen = nets.batches.first(runs.stop - start), self._seen[number, runs]
            self._tables.read(runs, block.batch[number, runs], self.updates + 1, given, seen)
            finite &= nets.update(role, runs, block.s[number, runs], rate, self._errors[number, runs])
        nets.count(role)
        self._tables.batches += 1
        self.updates += 1
        self._versions[role] = self.updates
        swapped = self.updates % self.config.swap_period == 0
        if swapped and self.config.two_networks:
            self._role = 1 - role
        elif swapped:
            nets.copy()
            self._versions[1] = self.updates
        self._archive(block, number)
        for k in self._going():
            self._agents[k].updates = self.updates
        if not finite:
            self._diverge(np.isfinite(self._errors[number]).all(1), "TD errors")
        if swapped or self.updates % self.config.learner.publish_every == 0:
            self._diverge(nets.finite(role), "parameters")

    def _diverge(self, finite: NDArray[np.bool_], what: str) -> None:
        for k in np.flatnonzero(~finite).tolist():
            trainer = self.runs[k].trainer
            trainer.diverged = trainer.diverged or f"diverged: {what} are not finite at update {self.updates}"

    def _mark_diverged(self) -> None:
        """End the runs that have diverged, once a step's updates are done."""
        for k in [k for k in self._going() if self.runs[k].trainer.diverged]:
            self._outcomes[k] = self.runs[k].trainer.diverged
            self.save_counters(k)

    def _going(self) -> list[int]:
        return [k for k, outcome in enumerate(self._outcomes) if not outcome]

    def _reached(self, runs: Sequence[int]) -> Iterator[int]:
        """Those of these runs that this step has ended, by another end than their steps."""
        for k in runs:
            if not self._outcomes[k] and self.step < self.config.total_steps:
                self._outcomes[k] = self.runs[k].trainer.outcome()
                if self._outcomes[k]:
                    yield k

    def _archive(self, block: _Block, number: int) -> None:
        """Give the diagnostics their first transitions."""
        for k in self._going():
            telemetry = self.runs[k].trainer.telemetry
            archive = telemetry.diagnostics.archive
            if archive is not None and len(archive) >= ARCHIVED:
                return
            batch = self._tables.batch(k, block.batch[number, k], self._seen[number, k])
            telemetry.diagnostics.add(batch)

    def _record(self, ended: Sequence[tuple[int, EpisodeEnd]], episodes: list[list[EpisodeRow]]) -> None:
        """Number the episodes that have ended."""
        for k, end in ended:
            run = self.runs[k]
            if not self._outcomes[k] or run.step == self.step:
                number = run.trainer.telemetry.episode(end.episode_return)
                row = EpisodeRow(number, EpisodeRecord(self.step, 0, 0, end), self.updates, run.agent.feedback_scale())
                episodes[k].append(row)

    def _rows(self, done: int, metrics: list[list[dict[str, Any]]]) -> None:
        """Make the rows of metrics of the interval that ends with the block."""
        self._push(done)
        for k in self._going():
            self.save_networks(k)
            self.save_counters(k)
            with torch.inference_mode(mode=False):  # where views of layers would not know what they are of
                row = self.runs[k].trainer._metrics(time.monotonic())
            metrics[k] += [] if row is None else [row]

    def _push(self, done: int) -> None:
        """Hand the telemetry what it has not been told of the first `done` updates of the block."""
        for k in self._going():
            telemetry = self.runs[k].trainer.telemetry
            for number in range(self._told, done):
                ids, age, reuse, lag, terminated = self._seen[number, k]
                telemetry.add_errors(self._errors[number, k])
                telemetry._batches.append((age, reuse, lag, terminated, ids))
        self._told = done

    def _follow(self, k: int, count: int, answers: tuple[Array, ...], restarts: Sequence[tuple[int, Array]]) -> None:
        """Note the first actions of run k in a block, and what its emulator answered, as `Lockstep` does step by step.

        answers: to the actions: observations, as rows, rewards and terminations: [count, K, ...], after the actions.
        restarts: the steps that ended an episode, and the rows that the next ones begin with.
        """
        run, held, spec = self.runs[k], self._tables.packing, self._agents[0].spec
        actions, obs, rewards, terminated = (each[:count, k] for each in answers)
        entries = [("obs", spec.frame_dtype, spec.obs_shape), ("reward", np.float64), ("terminated", np.bool_)]
        shown = np.empty(count, entries)
        shown["obs"], shown["reward"], shown["terminated"] = held.obs(obs), rewards, terminated
        start, seen = 0, run._seen
        for place, first in restarts:
            begun = held.obs(first[None]).tobytes()
            seen = zlib.crc32(begun, zlib.crc32(shown[start : place + 1].tobytes(), seen))
            start = place + 1
        run._actions += actions.tolist()
        run._seen = zlib.crc32(shown[start:].tobytes(), seen)

    def _draw_again(self, k: int, block: _Block, count: int) -> None:
        """Bring run k's generators to where they are after the first steps of a block."""
        for rng, state in zip(self._generators(k), block.generators[k], strict=True):
            set_generator_state(rng, state)
        self._draw(k, block, count)

    def save_into(self, k: int) -> None:
        """Bring run k to where its seed is, so that `Lockstep.save` saves it; it is not to be played on otherwise."""
        run = self.runs[k]
        self.save_networks(k)
        self.save_counters(k)
        run.memory = self._tables.memory(k)
        self._nets.save_means(k)

    def save_networks(self, k: int) -> None:
        """Write run k's networks and its role into its agent."""
        self._nets.save(k)
        agent = self._agents[k]
        agent.acting, agent.versions = self._role, list(self._versions)

    def save_counters(self, k: int) -> None:
        """Write run k's counters into its trainer."""
        run = self.runs[k]
        run.step, telemetry = self.step, run.trainer.telemetry
        self._agents[k].updates = self.updates
        telemetry.largest_reward = max(telemetry.largest_reward, float(self._tables.largest[k]))
        run.trainer.drawn = msgspec.structs.replace(
            run.trainer.drawn, inserted=self.step, **self._tables.counters(k), episodes=()
        )  # fmt: skip


def _parts(
    runs: Sequence[Lockstep], agents: Sequence[Agent], packing: Packing
) -> tuple[Carts, Networks] | tuple[Games, PictureNetworks]:
    """The emulators and networks of some runs, where they are."""
    config, players = runs[0].config, [run._player for run in runs]
    lengths = np.concatenate([player._lengths for player in players])
    if config.network.kind == "mlp":
        carts, limits = zip(*(cart_of(run.env) for run in runs), strict=True)
        return Carts(carts, lengths, limits[0], config.env.time_limit_terminal), Networks(agents)
    obs = np.concatenate([packing.rows(player._obs) for player in players])
    returns = np.concatenate([player._returns for player in players])
    return Games([run.env for run in runs], obs, returns, lengths), PictureNetworks(agents)
