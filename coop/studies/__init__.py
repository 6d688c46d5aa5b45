"""Many runs: grids, sweeps and reports."""
