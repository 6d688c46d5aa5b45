"""The status that each role publishes twice a second, for displays, and the replay service's counters on request.

Readers of a status ignore fields that they do not know.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Self

import msgspec
from msgspec import Meta

from coop.common.bounded import Counter, Name, Real, Share, Text
from coop.common.bounds import MAX_POINTS
from coop.common.messaging import wire
from coop.common.messaging.members import ROLES
from coop.common.messaging.messages.body import Body, bad_field, check_kind
from coop.common.messaging.messages.weights import Network
from coop.common.messaging.wire import Message
from coop.common.metrics import MEASURED

KIND = "status"
MAX_MEMBERS = 256  # listed in one status
MAX_MISSING = 1024  # named in one status

Counts = Annotated[list[Counter], Meta(max_length=64)]
Returns = Annotated[list[Real], Meta(max_length=MAX_POINTS)]
RoleName = Annotated[str, Meta(pattern=f"^({'|'.join(ROLES)})$")]
State = Annotated[str, Meta(pattern="^(training|serving|playing|waiting|lost)$")]


class Status(msgspec.Struct, frozen=True):
    """The status of one process."""

    def encode(self, run: str) -> bytearray:
        """Build the message."""
        return wire.encode(KIND, run, self)

    @classmethod
    def decode(cls, message: Message) -> Self:
        """Read it, ignoring other fields; raises BadMessage."""
        check_kind(message, KIND)
        try:
            return msgspec.convert(message.fields, cls, strict=True)
        except msgspec.ValidationError as error:
            raise bad_field(error, message.fields) from error


class ActorStatus(Status, frozen=True):
    """An actor's status.

    steps: played by this process. acked: of them acknowledged by the replay service. waiting: why it waits, in words.
    """

    steps: Counter
    acked: Counter
    steps_per_s: Real = 0.0
    waiting: Text = ""


class Held(msgspec.Struct, frozen=True):
    """How the limiter has held up requests of one kind since the last status.

    share: of the time in which one waited. reason: why the last one waited, in words; empty if none did.
    """

    share: Share = 0.0
    reason: Text = ""


class Ratio(msgspec.Struct, frozen=True):
    """The replay ratio, in updates per environment step.

    target: as set. measured: since the first update was due; null before. ahead: environment steps by which acting is
    ahead of learning, negative if it is behind. least, most: the band in which the limiter keeps `ahead`; null, like
    it, if the run's files alone are known.
    """

    target: Real
    measured: Real | None
    ahead: Real | None = None
    least: Real | None = None
    most: Real | None = None


class ReplayStatus(Status, frozen=True):
    """The replay service's status; counters as in `ReplayStats`, which it answers on request."""

    size: Counter
    inserted: Counter
    drawn: Counter
    ratio: Ratio
    inserts: Held = Held()
    samples: Held = Held()
    bad_messages: Counter = 0
    faults: Counter = 0


class Member(msgspec.Struct, frozen=True):
    """A process of the run.

    name: role, and an actor's number. steps_per_s: of an actor. reason: why it waits, in words; otherwise empty.
    """

    name: Name
    role: RoleName
    host: Name
    pid: Counter
    state: State
    steps_per_s: Real | None = None
    reason: Text = ""


class Wait(msgspec.Struct, frozen=True):
    """Who waits for whom, the share of the last half second in which it did, and the reason in words."""

    who: Name
    for_whom: Name
    share: Share
    reason: Text


if TYPE_CHECKING:

    class Measured(msgspec.Struct, frozen=True):
        """Columns of the newest row of metrics.jsonl, those of `coop.common.metrics.MEASURED`; null if not known."""

        def __init__(self, **columns: float | list[int] | None) -> None: ...

else:
    Measured = msgspec.defstruct(
        "Measured",
        [(name, Counts | None if listed else Real | None, None) for name, listed in MEASURED.items()],
        frozen=True,
        kw_only=True,
        module=__name__,
    )


class LearnerStatus(Status, frozen=True):
    """The status of the learner, which also reports on the other roles: displays reach the learner only.

    connected: number of processes by role, of the replay services only the one that serves. missing: lost processes.
    events: the newest lines of its console, with increasing numbers. origin: its host and process id. seconds: that
    the run has taken. seconds_left: estimated from the present speed; null while unknown. updates_to_swap: until
    the roles swap, or until the network is copied to its target if `two_networks` is false. size, capacity: of the
    table, in transitions. return_history: the 100-episode mean at evenly spaced episodes of the whole run, at most
    128 values. members: lost ones first. ratio: null until the replay service has reported. measured: null before the
    first row of metrics.jsonl.
    """

    env_steps: Counter
    total_steps: Counter
    updates: Counter
    updates_per_s: Real
    acting: Network
    episodes: Counter
    return_mean_100: Real
    epsilon: Share
    s: Real
    waiting: Text
    connected: dict[Name, Counter]
    warning: Text
    missing: Annotated[list[Text], Meta(max_length=MAX_MISSING)]
    events: Annotated[list[tuple[int, Text]], Meta(max_length=64)]
    origin: Text
    env: Name = ""
    method: Name = ""
    seed: Counter = 0
    seconds: Real = 0.0
    seconds_left: Real | None = None
    env_steps_per_s: Real = 0.0
    two_networks: bool = True
    updates_to_swap: Counter = 0
    size: Counter = 0
    capacity: Counter = 0
    return_history: Returns = []
    ratio: Ratio | None = None
    waits: Annotated[list[Wait], Meta(max_length=8)] = []
    members: Annotated[list[Member], Meta(max_length=MAX_MEMBERS)] = []
    measured: Measured | None = None
    bad_messages: Counter = 0
    faults: Counter = 0


class StatsQuestion(Body, frozen=True):
    """Asks for the counters."""

    kind: ClassVar[str] = "stats"


class ReplayStats(Body, frozen=True):
    """The replay service's counters, in transitions unless stated otherwise.

    drawn: batches. lost: transitions acknowledged to an actor but missing here. duplicates: segments delivered again
    and refused. faults: answers that failed because of a bug in this program.
    """

    kind: ClassVar[str] = "stats"

    size: Counter
    inserted: Counter
    drawn: Counter
    evicted: Counter
    evicted_unsampled: Counter
    duplicates: Counter
    lost: Counter
    episodes: Counter
    bad_messages: Counter
    inserts_wait_for: Text
    samples_wait_for: Text
    faults: Counter = 0
