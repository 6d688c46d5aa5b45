"""The actor role: emulators, the epsilon-greedy policy and the assembly of segments."""

import common  # noqa: F401 (first: it answers a Ctrl-C while the rest is imported)
