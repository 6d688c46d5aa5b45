"""Grids of runs: their definition, and their execution on this machine, as Slurm job arrays or on a Dask cluster."""
