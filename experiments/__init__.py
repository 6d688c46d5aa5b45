"""Combines the roles' objects in one process: lockstep runs, evaluation, re-execution, sweeps and reports."""

import common  # noqa: F401 (first: it handles a Ctrl-C during the other imports)
