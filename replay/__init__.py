"""The replay role: the table of transitions, its limiter and the service around them. Never imports torch."""

import common  # noqa: F401 (first: it answers a Ctrl-C while the rest is imported)
