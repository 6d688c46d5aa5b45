"""Grids of runs: what they hold, and running them, here or as a job array."""
