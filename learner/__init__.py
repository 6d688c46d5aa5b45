"""The learner role: error-driven learning, the four methods and the training loop."""

import common  # noqa: F401 (first: it handles a Ctrl-C during the other imports)
