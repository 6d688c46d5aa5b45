"""What a run leaves behind: its directory, metrics, summary, learning curve and checkpoints."""
