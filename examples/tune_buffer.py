"""Which learning rate and batch size suit a small buffer? A search by Optuna: pip install 'coop-rl[optuna]'."""

import sys

import coop

grid = {
    "methods": ["coop"],
    "seeds": [0, 1],
    "fixed": {"total_steps": 20_000, "replay": {"capacity": 200, "learning_starts": 100}},
    "vary": {"learner": {"learning_rate": {"low": 1e-5, "high": 1e-2, "log": True}, "batch_size": [16, 32, 64]}},
}
if len(sys.argv) > 1:  # a shorter search
    grid["fixed"]["total_steps"] = int(sys.argv[1])
study = coop.tune(grid, "runs/tuned", trials=4 if len(sys.argv) > 1 else 50, workers=2)
print(study.best_value, study.best_params)
