"""Types of single settings, with the bounds that pydantic checks."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from common.bounds import MAX_INTEGER, MAX_STEPS

Positive = Annotated[int, Field(gt=0, le=MAX_INTEGER)]
Count = Annotated[int, Field(ge=0, le=MAX_INTEGER)]
Steps = Annotated[int, Field(gt=0, le=MAX_STEPS)]
PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
PositiveShare = Annotated[float, Field(gt=0, le=1)]
Decay = Annotated[float, Field(ge=0, lt=1)]
