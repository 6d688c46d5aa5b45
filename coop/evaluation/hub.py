"""A run as a model repository, as `huggingface_hub` uploads it: a model card, networks, config and a film."""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coop.common.errors import CoopError
from coop.common.places import shown
from coop.common.settings.config import RunConfig
from coop.common.settings.tables import run_config_text
from coop.evaluation.evaluate import Evaluation, evaluate
from coop.evaluation.export import check_folder, export
from coop.evaluation.film import Film, check_video, write_video
from coop.evaluation.saved import SavedPolicy, SavedRun

EPISODES = 20  # of the evaluation that the card reports
CARD, CONFIG = "README.md", "config.toml"
FILMS = ("replay.mp4", "replay.gif")  # what the Hub shows beside a card


@dataclass(frozen=True)
class _Facts:
    """What a card says."""

    config: RunConfig
    result: Evaluation
    steps: int
    updates: int
    command: str
    version: str
    film: str


def export_hub(run_dir: Path, out: Path) -> str:
    """Write a run's newest networks as a model repository to `out`; return what was written, in words.

    The card reports greedy play of `EPISODES` episodes in the run's environment.

    Raises:
        UsageError: the run has no checkpoint, or `out` has other files.
        RunError: `out` cannot be written; or the environment fails.
    """
    run = SavedRun(run_dir)
    names = (CARD, CONFIG, *FILMS)
    check_folder(out, "--hub", names)
    checkpoint, policy = run.checkpoint(), run.policy()
    result = evaluate(policy, episodes=EPISODES)
    film, content, why = _filmed(policy, run.config)
    command = "coop-local" if (run_dir / "logs" / "learner.log").exists() else "coop-lockstep"
    facts = _Facts(run.config, result, checkpoint.env_steps, checkpoint.number, command, _version(), film)
    also: dict[str, bytes | None] = dict.fromkeys(FILMS)
    also |= {CARD: _card(facts).encode(), CONFIG: run_config_text(run.config).encode()}
    if content is not None:
        also[film] = content
    done = export(run_dir, out, "--hub", also)
    told = f"checkpoint {done.checkpoint} in {shown(run_dir)}: {', '.join(done.names)} in {shown(out)}"
    told += f"; no film: {why}" if why else ""
    return f"{told}\nhf upload USER/{_name(run.config)} {shown(out)} .   uploads it (pip install huggingface_hub)"


def iqm(returns: list[float]) -> float:
    """The interquartile mean: of the middle half of the returns, those at its borders in part."""
    ordered, count = np.sort(np.asarray(returns, np.float64)), len(returns)
    places = np.arange(count)
    weights = np.minimum(places + 1 - count / 4, count - count / 4 - places).clip(0, 1)
    return float(np.average(ordered, weights=weights))


def _filmed(policy: SavedPolicy, config: RunConfig) -> tuple[str, bytes | None, str]:
    """A film's name and content, and why there is none."""
    with tempfile.TemporaryDirectory(prefix="coop-") as folder:
        path = Path(folder) / FILMS[0]
        try:
            check_video(path)
        except CoopError:  # without an encoder
            path = Path(folder) / FILMS[1]
        try:
            write_video(Film(policy, config.env, config.seed), path)
        except (CoopError, OSError) as error:
            return "", None, str(error).splitlines()[0]
        return path.name, path.read_bytes(), ""


def _version() -> str:
    """The version of this package, and the commit if it lies in a clone."""
    version = importlib.metadata.version("coop-rl")
    folder = Path(__file__).resolve().parent
    try:
        asked = ["git", "-C", str(folder), "rev-parse", "HEAD"]
        done = subprocess.run(asked, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return version
    commit = done.stdout.strip()
    return f"{version}, commit {commit}" if done.returncode == 0 and commit else version


def _name(config: RunConfig) -> str:
    named = f"coop-{config.method}-{config.env.id}"
    return "".join(letter if letter.isalnum() or letter in "-." else "-" for letter in named)


def _card(facts: _Facts) -> str:
    """The model card: a header in YAML, whose strings are those of JSON, and a page."""
    config, result = facts.config, facts.result
    env, name, mean = config.env.id, _name(config), f"{result.mean:.2f} +/- {result.sd:.2f}"
    text, middle = json.dumps, iqm(result.returns)
    eviction = "no buffer" if config.streaming else f"{config.replay.capacity:,} transitions, {config.replay.eviction}"
    tags = ("reinforcement-learning", "deep-reinforcement-learning", "coop", "dqn", env)
    film = f"\n![An episode of the policy]({facts.film})\n" if facts.film.endswith("gif") else ""
    return f"""---
library_name: coop-rl
tags:
{"".join(f"- {text(tag)}{chr(10)}" for tag in tags)}model-index:
- name: {text(name)}
  results:
  - task:
      type: reinforcement-learning
      name: reinforcement-learning
    dataset:
      name: {text(env)}
      type: {text(env)}
    metrics:
    - type: mean_reward
      value: {text(mean)}
      name: mean_reward
      verified: false
    - type: iqm_reward
      value: {middle:.6g}
      name: interquartile mean
      verified: false
coop:
  environment: {text(env)}
  method: {text(config.method)}
  capacity: {0 if config.streaming else config.replay.capacity}
  eviction: {text(config.replay.eviction)}
  ratio: {config.replay.ratio:g}
  seed: {config.seed}
  env_steps: {facts.steps}
  updates: {facts.updates}
  iqm: {middle:.6g}
  command: {text(f"{facts.command} --config config.toml")}
  version: {text(facts.version)}
---

# {config.method} on {env}

| | |
| --- | --- |
| environment | `{env}` |
| method | `{config.method}` |
| replay buffer | {eviction} |
| updates per environment step | {config.replay.ratio:g} |
| environment steps, updates | {facts.steps:,}, {facts.updates:,} |
| greedy play, {len(result.returns)} episodes | interquartile mean {middle:.6g}, mean {mean} |
| made by | `{facts.command} --config config.toml`, coop-rl {facts.version} |
{film}
`card.json` says what the networks are and how observations are prepared; `network-{{1,2}}.safetensors` hold the
parameters, `network-{{1,2}}.onnx` the networks with their preprocessing. `config.toml` has every setting of the run.
"""
