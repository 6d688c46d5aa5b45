"""Types of the numbers and texts that processes exchange, each with its bounds.

msgspec checks them when it reads a message. A NaN lies within no bounds.
"""

from __future__ import annotations

import sys
from typing import Annotated

from msgspec import Meta

from coop.common.bounds import MAX_COUNT, MAX_ENV_ID, MAX_FLOAT32, MAX_INTEGER, MAX_UPDATES

Incarnation = Annotated[int, Meta(ge=0, le=MAX_INTEGER)]
Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
"""Steps, segments or episodes."""
Updates = Annotated[int, Meta(ge=0, le=MAX_UPDATES)]
Counter = Annotated[int, Meta(ge=0, le=MAX_INTEGER)]
"""A service's count of events, which may exceed those of one run, or a planned number of them."""
Real = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Float32 = Annotated[float, Meta(ge=-MAX_FLOAT32, le=MAX_FLOAT32)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Name = Annotated[str, Meta(max_length=MAX_ENV_ID)]
Text = Annotated[str, Meta(max_length=1024)]
