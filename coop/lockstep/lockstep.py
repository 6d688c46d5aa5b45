"""Algorithm 1 exactly: act, store, sample, update, toggle, in one process with the roles' objects."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterator

import msgspec
import numpy as np
import torch

from coop.actors.player import Player, Turn
from coop.actors.policy import EpsilonGreedy
from coop.common.envs.make import make_vector_env
from coop.common.errors import RunError, UsageError
from coop.common.numbers import generator_state, set_generator_state
from coop.common.process.console import say
from coop.common.settings.config import RunConfig
from coop.common.types import EpisodeRecord
from coop.learner.trainer import Effects, Trainer
from coop.lockstep.memory import make_experience
from coop.records.checkpoints import REPLAY
from coop.records.learner_checkpoints import check_spec, fitting, saving_checkpoint
from coop.records.resumption import Whole
from coop.records.run_directory import RunDirectory
from coop.replay.persistence.storage import Mark

Replaying = Callable[[int, int], None]  # actions played again, all of them
PROGRESS_EVERY = 5.0  # seconds between lines of progress
LOOK_EVERY = 0.2  # seconds between looks for a request of a checkpoint


class Lockstep:
    """One run of Algorithm 1 with one emulator; deterministic to the bit for a seed.

    step: number of environment steps done.
    """

    def __init__(self, config: RunConfig) -> None:
        if config.actor.num_envs != 1:
            raise UsageError(f"actor.num_envs = {config.actor.num_envs}: lockstep runs play one emulator")
        env_seed, policy_seed = np.random.SeedSequence([config.seed, 3, 0]).spawn(2)
        self.config = config
        self.step = 0
        self.env = make_vector_env(config.env, 1, int(env_seed.generate_state(1)[0]))
        self.agent, self.memory = make_experience(config, self.env.spec)
        self.trainer = Trainer(self.agent, time.monotonic())
        self._policy_rng = np.random.default_rng(policy_seed)
        first, second = self.agent.networks
        self._policy = EpsilonGreedy((first, second), self.env.spec, self._policy_rng)
        self._player = Player(self.env, self._policy, self.agent.epsilon)
        self._actions: list[int] = []
        first_obs = self._player.begin()
        self._seen = zlib.crc32(first_obs.tobytes())
        self.memory.begin(first_obs)

    def play(self) -> Iterator[Effects]:
        """Run one iteration of Algorithm 1's inner loop, offline without acting; yields the effects of each update."""
        learner = self.config.learner
        turn: Turn | None = None
        if not self.config.replay.offline:
            self._policy.acting = self.agent.acting
            self._player.send(self.step, self.agent.updates)
            turn = self._player.recv()
            self._follow(turn)
        self.step += 1
        if turn is not None:
            self.memory.add(turn, self.step)
        drawn = msgspec.structs.replace(self.trainer.drawn, inserted=self.step, **self.memory.counters())
        for batch in self.memory.batches(self.step):
            effects = self.trainer.train(batch, drawn, time.monotonic())
            if effects.ids is not None and effects.priorities is not None:
                self.memory.update_priorities(effects.ids, effects.priorities)
            yield effects
        ends = turn.ended if turn is not None else {}
        ended = tuple(EpisodeRecord(self.step, 0, stream, end) for stream, end in ends.items())
        yield self.trainer.receive(msgspec.structs.replace(drawn, episodes=ended))
        if learner.swap_unit == "steps" and self.step % self.config.swap_period == 0:
            self.agent.swap()
        if learner.reset_role_at_episode and ends and self.agent.acting:
            self.agent.swap()

    def _follow(self, turn: Turn) -> None:
        """Note the action, and add what the emulator answered to a checksum of all that it showed."""
        self._actions.append(int(turn.actions[0]))
        steps = turn.steps
        newest = steps.next_obs[0, -1] if self.env.spec.stack > 1 else steps.next_obs
        restarted = [steps.obs] if steps.restarted[0] else []
        masks = [] if steps.next_mask is None else [steps.next_mask]
        for shown in (newest, steps.raw_rewards, steps.terminated, *restarted, *masks):
            self._seen = zlib.crc32(shown.tobytes(), self._seen)

    def progress(self) -> str:
        """Where it is, in a line."""
        telemetry = self.trainer.telemetry
        returns = f"return {telemetry.return_mean:.1f}" if telemetry.episodes else "no episode has ended yet"
        warning = telemetry.warning(self.agent)
        return f"step {self.step:,}/{self.config.total_steps:,}  {returns}" + (f"  [{warning}]" if warning else "")

    def save(self, directory: RunDirectory) -> None:
        """Save a checkpoint that `restore` continues exactly to the bit.

        Raises:
            RunError: the run directory can't be written; nothing is left of this checkpoint.
        """
        state = {
            **self.trainer.state(time.monotonic()),
            "player": {
                "policy": generator_state(self._policy_rng),
                "actions": torch.tensor(self._actions),
                "seen": self._seen,
            },
        }
        run_id, number = directory.run_id(), self.agent.updates
        try:
            with saving_checkpoint(
                directory.path,
                run_id,
                number,
                state,
                records=directory.records(),
                fallbacks=directory.fallbacks,
                settings=directory.settings,
            ) as path:
                self.memory.save(path / REPLAY, Mark(run_id, number, 0))
        except OSError as error:
            text = f"checkpoint {self.agent.updates} in {directory.path}: {error.strerror or error}"
            raise RunError(text) from error

    def save_on_the_way(self, directory: RunDirectory) -> None:
        """Save a checkpoint that was due; one for which there is no space costs a line."""
        self.trainer.checkpoint_begun()
        try:
            self.save(directory)
        except RunError as error:
            say(f"{error}; the run goes on without it")

    def restore(self, checkpoint: Whole, replaying: Replaying = lambda played, actions: None) -> None:
        """Restore a whole checkpoint from `save`.

        The emulator's state is restored by playing the same actions again, which is exact for every deterministic
        environment. replaying: called before each action with how many are played and how many there are.

        Raises:
            UsageError: the checkpoint does not belong to a lockstep run, or not to one like this.
            RunError: the environment is not deterministic: its observations, rewards or ends differ from the run's.
        """
        state = checkpoint.state
        if "player" not in state:
            raise UsageError(f"{checkpoint.path}: saved by a distributed run; coop-local --resume continues it")
        with fitting(checkpoint.path):
            check_spec(checkpoint, self.env.spec)
            self._replay_actions(state["player"]["actions"].tolist(), replaying)
            if state["player"]["seen"] != self._seen:
                raise RunError(
                    f"{checkpoint.path}: {self.config.env.id} showed something else when the run's "
                    f"{len(self._actions):,} actions were played again; a lockstep run goes on "
                    "only where the seed determines the environment"
                )
            self.memory.load(checkpoint.path / REPLAY, Mark(checkpoint.manifest.run, checkpoint.number, 0))
            self.trainer.load_state(state, time.monotonic())
            set_generator_state(self._policy_rng, state["player"]["policy"])
        self.step = self.trainer.drawn.inserted

    def _replay_actions(self, actions: list[int], replaying: Replaying) -> None:
        """Play the actions of a run again; the memory is restored separately."""
        for step, action in enumerate(actions, 1):
            replaying(step - 1, len(actions))
            turn = self._player.replay(np.array([action], np.int32))
            self.memory.follow(turn, step)
            self._follow(turn)
