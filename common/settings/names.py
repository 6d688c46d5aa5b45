"""Types of settings that choose an entry of a registry by its name."""

from __future__ import annotations

from typing import Annotated, Any

import tyro
from pydantic import AfterValidator
from pydantic_core import PydanticCustomError

from coop.common.registry import Registry
from coop.common.settings.methods import METHODS
from coop.common.settings.policies import EVICTIONS, SAMPLERS


def _known(registry: Registry[Any]) -> AfterValidator:
    def check(name: str) -> str:
        if not registry.knows(name):
            raise PydanticCustomError("unknown_name", "{reason}", {"reason": registry.unknown(name)})
        return name

    return AfterValidator(check)


def _shown(registry: Registry[Any]) -> object:
    return tyro.conf.arg(metavar=f"{{{','.join(registry.names())}}}")


MethodName = Annotated[str, _known(METHODS)]
EvictionName = Annotated[str, _known(EVICTIONS), _shown(EVICTIONS)]
SamplingName = Annotated[str, _known(SAMPLERS), _shown(SAMPLERS)]
