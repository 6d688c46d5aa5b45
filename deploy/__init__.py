"""Starts and watches processes; never imports a role's code."""

import common  # noqa: F401 (first: it handles a Ctrl-C during the other imports)
