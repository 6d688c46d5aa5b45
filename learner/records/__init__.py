"""The records of a run: its directory, metrics, summary, learning curve and checkpoints."""
