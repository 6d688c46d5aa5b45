"""Eight emulators of Breakout alone, four frames a step, no pictures taken: acting_ale.py."""

import ale_py
import numpy as np
from turns import attend, processor_rate
from work import EMULATORS

ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
games = []
for seed in range(EMULATORS):
    game = ale_py.ALEInterface()
    game.setInt("random_seed", seed)
    game.setFloat("repeat_action_probability", 0.0)
    game.loadROM(ale_py.roms.get_rom_path("breakout"))
    games.append(game)
actions = games[0].getMinimalActionSet()
rng = np.random.default_rng(0)


def step() -> None:
    for game in games:
        action = actions[rng.integers(len(actions))]
        for _ in range(4):
            game.act(action)
        if game.game_over():
            game.reset_game()


attend(lambda seconds: processor_rate("steps/s", step, seconds, EMULATORS))
