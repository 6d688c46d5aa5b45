"""The learner role: error-driven learning, the four methods and the training loop."""
