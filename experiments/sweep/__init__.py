"""Grids of runs: their definition, and their execution on this machine or as Slurm job arrays."""
