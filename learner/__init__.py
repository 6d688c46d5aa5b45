"""The learner role: error-driven learning, the four methods and the training loop."""

import common  # noqa: F401 (first: it answers a Ctrl-C while the rest is imported)
