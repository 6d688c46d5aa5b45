"""The replay role: the table of transitions, its limiter and the service around them. Never imports torch."""

import common  # noqa: F401 (first: it handles a Ctrl-C during the other imports)
