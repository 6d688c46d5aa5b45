"""Error-driven learning: passes through a network, layer by layer, and the feedback B = U (S + sI) V^T."""

from coop.learner.edl.feedback import edl_gradients, feedback_matrices

__all__ = ["edl_gradients", "feedback_matrices"]
