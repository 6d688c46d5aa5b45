"""Environments of one's own: found in modules and packages, given keyword arguments, and shown as they are."""

from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from coop.common.envs import registry
from coop.common.envs.make import env_spec, make_vector_env
from coop.common.envs.pictures import grayscale, make_resizer
from coop.common.errors import UsageError
from coop.common.networks.forward import preprocess
from coop.common.networks.network import FlatNetwork, build_network
from coop.common.settings.environment import EnvSettings
from coop.common.settings.tables import load_tables, resolve
from coop.common.types import Array, EnvSpec


class Scene(gymnasium.Env[Array, int]):
    """A picture or vector whose values count the steps; actions begin at 3."""

    def __init__(self, shape: tuple[int, ...], dtype: Any = np.uint8, most: float = 255, shown: Any = None) -> None:
        self.observation_space = Box(0, most, tuple(shape), dtype)
        self.action_space = Discrete(2, start=3)
        self.shown = shown or dtype

    def picture(self, value: int) -> Array:
        space = self.observation_space
        counted = np.arange(int(np.prod(space.shape))) + value
        return (counted % 251 / 251 * space.high.max()).astype(self.shown).reshape(space.shape)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.count = 10
        return self.picture(self.count), {}

    def step(self, action: int) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        assert action in {3, 4}
        self.count += 1
        return self.picture(self.count), 0.25, False, self.count == 13, {}


SCENES: dict[str, tuple[tuple[int, ...], Any, float]] = {
    "Colour": ((20, 16, 3), np.uint8, 255),
    "Gray": ((5, 10, 1), np.uint8, 255),
    "Flat": ((84, 84), np.uint8, 255),
    "Planes": ((10, 10, 7), np.bool_, 1),
    "Depth": ((9, 12, 2), np.float32, 1),
    "Wide": ((6, 6), np.float64, 1),
    "Bits": ((9,), np.bool_, 1),
    "Bytes": ((128,), np.uint8, 255),
    "Many": ((3, 4, 5, 6), np.uint8, 255),
}
for name, (shape, dtype, most) in SCENES.items():
    gymnasium.register(f"test/{name}-v0", entry_point=Scene, kwargs={"shape": shape, "dtype": dtype, "most": most})


@pytest.mark.parametrize("name", [name for name in SCENES if name != "Many"])
@pytest.mark.parametrize("stack", [1, 3])
def test_observations_stay_as_they_are(name: str, stack: int) -> None:
    shape, dtype, most = SCENES[name]
    settings = EnvSettings(id=f"test/{name}-v0", stack=stack, clip_rewards=True)
    kept = "float32" if dtype in (np.float32, np.float64) else np.dtype(dtype).name
    assert env_spec(settings) == EnvSpec(settings.id, shape, kept, stack, 2)
    env, scene = make_vector_env(settings, 1, 0), Scene(shape, dtype, most)
    frames = [np.zeros(shape, kept)] * 3 + [scene.picture(value).astype(kept) for value in (10, 11, 12, 13)]

    def stacked(last: int) -> Array:
        return np.array(frames[last + 1 - stack : last + 1]) if stack > 1 else frames[last]

    np.testing.assert_array_equal(env.reset()[0], stacked(3))
    for last in (4, 5):
        step = env.step(np.array([0], np.int32))
        np.testing.assert_array_equal(step.obs[0], stacked(last))
        assert (step.obs.dtype, step.rewards.tolist()) == (kept, [0.25])
    step = env.step(np.array([1], np.int32))
    np.testing.assert_array_equal(step.next_obs[0], stacked(6))
    np.testing.assert_array_equal(step.obs[0], stacked(3))
    assert step.restarted.all()
    assert not step.terminated.any()
    env.close()


@pytest.mark.parametrize("kind", ["mlp", "minatar", "own planes"])
@pytest.mark.parametrize("name", ["Colour", "Gray", "Planes", "Depth", "Wide", "Bytes", "Bits"])
@pytest.mark.parametrize("stack", [1, 2])
def test_networks_see_planes_and_vectors_of_any_size(name: str, stack: int, kind: str) -> None:
    """uint8 / 255, bool and float as they are; PyTorch and numpy agree to the bit."""
    spec = env_spec(EnvSettings(id=f"test/{name}-v0", stack=stack))
    env = make_vector_env(EnvSettings(id=spec.env_id, stack=stack), 3, 0)
    obs = env.reset()
    x, in_numpy = preprocess(torch.from_numpy(obs), spec), preprocess(obs, spec)
    assert x.shape == in_numpy.shape == (3, *spec.input_shape)
    assert (x.dtype, in_numpy.dtype) == (torch.float32, np.float32)
    np.testing.assert_array_equal(x.numpy(), in_numpy)
    plain = obs.astype(np.float32) * np.float32(1 / 255) if spec.frame_dtype == "uint8" else obs.astype(np.float32)
    if kind == "own planes":
        for frame in range(stack):
            one = plain[:, frame] if stack > 1 else plain
            if len(spec.frame_shape) == 3:
                for channel in range(spec.frame_shape[2]):
                    seen = in_numpy[:, frame * spec.frame_shape[2] + channel]
                    np.testing.assert_array_equal(seen, one[..., channel])
            else:
                seen = in_numpy[:, frame] if len(spec.frame_shape) == 2 or stack > 1 else in_numpy
                np.testing.assert_array_equal(seen, one)
    elif kind == "minatar" and len(spec.frame_shape) == 1:
        with pytest.raises(UsageError, match=r"network\.kind = 'minatar': needs pictures"):
            build_network(kind, spec, (), 0)
    else:
        network = FlatNetwork(build_network(kind, spec, (16,), 0))
        assert network(x).shape == (3, 2)
    env.close()


def test_the_network_of_minatar() -> None:
    network = FlatNetwork(build_network("minatar", EnvSpec("x", (10, 10, 4), "bool", 1, 3), (), 0))
    assert [shape for _, shape in network.layout] == [
        (16, 4, 3, 3), (16,), (128, 1024), (128,), (3, 128), (3,),
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["nature", "nips2013"])
def test_convolutions_take_colour(kind: str) -> None:
    network = build_network(kind, EnvSpec("x", (64, 48, 3), "uint8", 2, 3), (), 0)
    assert network(torch.zeros(5, 6, 64, 48)).shape == (5, 3)


def test_a_network_too_large_for_a_message_is_refused() -> None:
    with pytest.raises(UsageError, match=r"network\.kind = 'minatar': .* parameters with frames \[2000, 2000\]"):
        build_network("minatar", EnvSpec("x", (2000, 2000), "uint8", 1, 2), (), 0)


def test_pictures_change_on_request() -> None:
    picture = np.zeros((168, 126), np.uint8)
    picture[0:2, 0:3] = [[12, 30, 90], [12, 30, 90]]
    small = make_resizer(picture.shape, (84, 84))(picture)
    assert small[0, :3].tolist() == pytest.approx([18, 70, 0])  # (12 + 30/2) / 1.5 and (30/2 + 90) / 1.5
    colour = np.zeros((84, 84, 3), np.uint8)
    colour[...] = (100, 200, 50)
    assert np.unique(np.rint(grayscale(colour))).tolist() == [153]  # 29.9 + 117.4 + 5.7
    settings = EnvSettings(id="test/Colour-v0", resize=(10, 8))
    scene = Scene((20, 16, 3)).picture(10).astype(np.float32)
    means = scene.reshape(10, 2, 8, 2, 3).mean(axis=(1, 3))
    env = make_vector_env(settings, 1, 0)
    assert env.spec == env_spec(settings) == EnvSpec("test/Colour-v0", (10, 8, 3), "uint8", 1, 2)
    np.testing.assert_array_equal(env.reset()[0], np.rint(means))
    gray = make_vector_env(EnvSettings(id="test/Colour-v0", resize=(10, 8), grayscale=True), 1, 0)
    assert gray.spec.frame_shape == (10, 8)
    np.testing.assert_allclose(gray.reset()[0], means @ [0.299, 0.587, 0.114], atol=0.51)
    depth = make_vector_env(EnvSettings(id="test/Depth-v0", resize=(3, 4)), 1, 0)
    expected = Scene(*SCENES["Depth"]).picture(10).reshape(3, 3, 4, 3, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(depth.reset()[0], expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"id": "CartPole-v1", "resize": (8, 8)}, ["env.resize = [8, 8]: needs pictures", "float32[4]"]),
        (
            {"id": "test/Planes-v0", "resize": (8, 8)},
            ["env.resize = [8, 8]: needs pictures in uint8 or float32", "bool"],
        ),
        (
            {"id": "test/Depth-v0", "grayscale": True},
            ["env.grayscale = true: needs three colour channels", "[9, 12, 2]"],
        ),
        ({"id": "test/Many-v0"}, ["(3, 4, 5, 6)", "allowed is a Box of one dimension, or of pictures"]),
        ({"id": "test/Gray-v0", "kwargs": {"shape": [70_000]}}, ["70,000 values on a side", "at most 65,536"]),
        ({"id": "CartPole-v1", "kwargs": {"sid": 12}}, ["env.kwargs = {'sid': 12}", "unexpected keyword argument"]),
        ({"id": "no_such_module:Room-v0"}, ["env.id: cannot import 'no_such_module'"]),
        ({"id": "json:Nowhere-v0"}, ["the module json does not register Nowhere-v0"]),
        ({"id": "NoSuchSpace/Room-v0"}, ["unknown environment 'NoSuchSpace/Room-v0'"]),
    ],
)
def test_what_does_not_fit_is_refused_in_words(options: dict[str, Any], words: list[str]) -> None:
    for make in (env_spec, lambda settings: make_vector_env(settings, 1, 0)):
        with pytest.raises(UsageError) as refusal:
            make(EnvSettings(**options))
        assert all(word in str(refusal.value) for word in words), str(refusal.value)
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(("field", "value"), [("kwargs", {"side": 3}), ("resize", [64, 64]), ("grayscale", True)])
def test_atari_keeps_its_standard(field: str, value: object) -> None:
    with pytest.raises(UsageError, match=rf"env\.{field} = .*: not for 'pong'"):
        resolve({"env": {"id": "pong", field: value}})


def test_observations_other_than_their_space_are_refused() -> None:
    settings = EnvSettings(id="test/Colour-v0", kwargs={"shown": "float64"})
    env = make_vector_env(settings, 1, 0)
    with pytest.raises(UsageError, match=r"gives observations float64\[20, 16, 3\]; .* says uint8\[20, 16, 3\]"):
        env.reset()


def test_a_module_s_environments_and_their_arguments() -> None:
    assert env_spec(EnvSettings(id="my_envs:Planes-v0")).frame_shape == (10, 10, 4)
    settings = EnvSettings(id="my_envs:Room-v0", kwargs={"kind": "depth", "side": 3})
    assert env_spec(settings) == EnvSpec("my_envs:Room-v0", (12, 9), "float32", 1, 2)
    env = make_vector_env(settings, 1, 0)
    env.reset()
    assert any(env.step(np.ones(1, np.int32)).terminated.all() for _ in range(2)), "a corridor of three cells"


def test_the_environment_of_the_documentation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[1] / "docs" / "environments.md").read_text()
    (tmp_path / "documented_envs.py").write_text(page.split("```python\n")[1].split("```")[0].replace("Room-", "Hall-"))
    monkeypatch.syspath_prepend(tmp_path)
    settings = EnvSettings(id="documented_envs:Hall-v0", kwargs={"side": 12})
    env = make_vector_env(settings, 2, 0)
    assert env.spec == env_spec(settings) == EnvSpec("documented_envs:Hall-v0", (64, 64, 3), "uint8", 1, 2)
    env.reset()
    ends = [env.step(np.array([0, 1], np.int32)) for _ in range(60)]
    assert any(step.terminated[1] for step in ends)
    assert any(step.restarted[0] and not step.terminated[0] for step in ends)


def register_for_tests() -> None:
    gymnasium.register("Planes-v3", entry_point=Scene, kwargs={"shape": (5,)})


def test_installed_packages_register_when_an_id_needs_them(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = [
        EntryPoint("plugin_of_tests", f"{__name__}:register_for_tests", "gymnasium.envs"),
        EntryPoint("other_plugin", "no_such_module:register", "gymnasium.envs"),
        EntryPoint("__root__", "no_such_module:register", "gymnasium.envs"),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: installed)
    assert env_spec(EnvSettings(id="plugin_of_tests/Planes-v3")).frame_shape == (5,)
    with pytest.raises(UsageError, match="cannot load 'no_such_module:register': ModuleNotFoundError"):
        env_spec(EnvSettings(id="Planes-v4"))


MINATAR = {"breakout": (4, 3), "space-invaders": (6, 4), "asterix": (4, 5), "freeway": (7, 3), "seaquest": (10, 6)}


@pytest.mark.parametrize("game", MINATAR)
def test_minatar_has_presets(game: str) -> None:
    pytest.importorskip("minatar")
    config = resolve(load_tables(f"minatar-{game}", None))
    channels, actions = MINATAR[game]
    assert env_spec(config.env) == EnvSpec(config.env.id, (10, 10, channels), "bool", 1, actions)
    env = make_vector_env(config.env, 2, 0)
    obs = env.reset()
    assert obs.shape == (2, 10, 10, channels)
    assert obs.any()
    build_network(config.network.kind, env.spec, config.network.hidden, 0)
    env.close()


def test_minatar_is_named_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "entry_points", lambda group: [])
    for known in [known for known in gymnasium.registry if known.startswith("MinAtar/")]:
        monkeypatch.delitem(gymnasium.registry, known)
    with pytest.raises(UsageError, match="ids of MinAtar need the package minatar, which is not installed"):
        env_spec(EnvSettings(id="MinAtar/Breakout-v1"))
