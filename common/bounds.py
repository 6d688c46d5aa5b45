"""Bounds that messages and settings share, so that no setting asks for more than a message can carry."""

from __future__ import annotations

MAX_SEGMENT_STEPS = 4096  # steps of one emulator that travel together
MAX_N_STEP = 100  # steps that a transition spans
MAX_BATCH = 65_536  # transitions of a batch
MAX_AHEAD = 1024  # draws by which a learner may be ahead of its base
MAX_STREAMS = 65_536  # emulators of one actor process
MAX_GAPS = 1024  # segments of a stream that may be missing while later ones have arrived
MAX_EVALUATED = 100_000  # episodes of an evaluation
MAX_VIDEO = 1 << 25  # bytes of a video in a message
MAX_RETURN = 1e15  # of an episode, in either direction
MAX_POINTS = 128  # values of a run's history of returns in a status
MAX_STACK = 64  # frames of an observation
MAX_ENV_ID = 256  # characters
MAX_KWARGS = 65_536  # bytes of an environment's keyword arguments in a message
MAX_SIDE = 65_536  # values of a frame along one dimension
MAX_ACTIONS = 100_000

MAX_PAYLOAD = 1 << 28  # bytes of a message; a session accepts no larger one from a peer
MAX_QUESTION = 1 << 20  # bytes of one that carries no segment, batch, network or video
MAX_LAYERS = 64  # hidden layers of a network
MAX_STEPS = 10**12  # environment steps of a run
MAX_COUNT = 2**40  # steps of an actor, segments of a stream, episodes: a little above MAX_STEPS
MAX_RATIO = 1e6  # updates per environment step; with MAX_STEPS, updates stay below 2^62
MAX_UPDATES = 2**62
MAX_TOLERANCE = 1e12  # environment steps
MAX_MAGNITUDE = 1e6  # of a reward and of an observation; networks learn nothing from larger values
MAX_FLOAT32 = 3.4028234663852886e38
MAX_INTEGER = 2**63 - 1  # the largest integer in TOML and in the counters on the wire

# ALE counts frames in 32 bits, MAX_FRAME_SKIP * MAX_GAME_STEPS of them at most.
MAX_NOOPS = 10_000
MAX_FRAME_SKIP = 1000
MAX_GAME_STEPS = 2_000_000
LONGEST_EPISODE = 10_000  # steps, of an evaluation's episodes where nothing else limits them
