"""Starts and watches processes; never imports a role's code."""

import common  # noqa: F401 (first: it answers a Ctrl-C while the rest is imported)
