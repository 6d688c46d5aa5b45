"""The protocol's times, all in seconds: how long a conversation waits, and how soon it tries again.

Two bounds hold them together. A replay service acknowledges for `LEASE` after it asked for a confirmation, on its own
clock; the learner admits another one `LEASE` after it gave that confirmation, which is later. So clocks need the same
rate to within the way of a message, but not the same time. And what a peer is asked to hold (`HOLD`) ends before the
question does (`ASK_TIMEOUT`), so that a refusal with its reason arrives instead of silence.
"""

from __future__ import annotations

# Links and questions
LEASE = 1.5
"""Silence after which a link is given up, and after which the learner's last confirmation expires."""
ASK_TIMEOUT = 5.0
"""An answer to an ordinary question."""
INSERT_TIMEOUT = 60.0
"""The acknowledgement of a segment, which may wait behind its whole window while the limiter admits segments one by
one; a lost peer is noticed sooner, by its link."""
PAUSES = (0.02, 1.0)
"""First and longest pause of a client of the replay service before it asks again; each is twice the last one."""
LOOKS = (0.001, 0.05)
"""First and longest pause between looks for an answer, while something else must be done too."""

# Joining, membership and departure
RETRY_PAUSE = 0.1
"""Before joining or leaving is tried again."""
JOIN_ANSWER = 1.0
"""The learner's answer to a join or a departure."""
HANDOVER_TIMEOUT = 5.0
"""What a replay service waits for another one to end; a dead one is given up sooner."""
ASK_EVERY = 0.4
"""Between a member's questions while its work depends on the answer: a replay service's do, by `LEASE`."""
IDLE_ASK_EVERY = 5.0
"""Between a member's questions otherwise."""
LEAVE_WITHIN = 25.0
"""What a stopping process stays because the learner still needs it."""
LOOK_EVERY = 0.1
"""Between looks whether a replay service has said which checkpoints it holds."""
REFUSAL = 0.5
"""For a refusal to reach the replay service before the learner ends."""
FORGOTTEN = 60.0
"""After which a lost member is no longer listed as missing."""

# Inserts and draws
HOLD = 1.0
"""What a request is held that the limiter does not admit, before it is answered with a refusal."""
ASKED_AGAIN = 2.5
"""After a refusal within which a client that is still there has asked again."""

# Weights and evaluations
GRACE = 0.5
"""For a broadcast before its weights are asked for."""
ANSWER_TIMEOUT = 2.0
"""The learner's answer to an actor's question for weights, and its receipt for an evaluation."""
RECEIPT_PAUSE = 0.1
"""Before an evaluation is sent, or networks are asked for, again."""
LAST_RECEIPT = 5.0
"""For the final networks, and for a receipt, at the run's end."""

# Checkpoints
SNAPSHOT_PATIENCE = 5.0
"""For the replay service's answer to a snapshot, also while it is restarting."""
WRITTEN_PAUSE = 0.05
"""Between questions whether the replay service's part is on the disk."""

# The run's end, and displays
REPLAY_BACK = 30.0
"""For an absent replay service when the run is complete, whose state the closing checkpoint needs."""
FAREWELL = 5.0
"""For the other roles to leave."""
FAREWELL_EVERY = 0.1
"""Between announcements of the end."""
LAST_EVALUATION = 60.0
"""For evaluators to evaluate a completed run's final networks, and leave."""
STATUS_EVERY = 0.5
"""Between statuses of a role for displays."""
