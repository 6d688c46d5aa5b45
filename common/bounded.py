"""Types of the numbers and texts that processes exchange, each with the bounds of what it can mean.

msgspec checks them where a message is read. A not-a-number lies within no bounds.
"""

from __future__ import annotations

import sys
from typing import Annotated

from msgspec import Meta

from common.bounds import MAX_COUNT, MAX_ENV_ID, MAX_FLOAT32, MAX_INTEGER, MAX_UPDATES

Incarnation = Annotated[int, Meta(ge=0, le=MAX_INTEGER)]
Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
"""Steps, segments or episodes."""
Updates = Annotated[int, Meta(ge=0, le=MAX_UPDATES)]
Counter = Annotated[int, Meta(ge=0, le=MAX_INTEGER)]
"""What a service counts or plans; it may count for longer than a run lasts."""
Real = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Float32 = Annotated[float, Meta(ge=-MAX_FLOAT32, le=MAX_FLOAT32)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Name = Annotated[str, Meta(max_length=MAX_ENV_ID)]
Text = Annotated[str, Meta(max_length=1024)]
