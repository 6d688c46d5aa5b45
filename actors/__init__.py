"""The actor role: emulators, the epsilon-greedy policy and the assembly of segments."""

import common  # noqa: F401 (first: it handles a Ctrl-C during the other imports)
