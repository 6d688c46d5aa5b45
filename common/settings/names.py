"""Types of settings that choose an entry of a registry by its name."""

from __future__ import annotations

from typing import Annotated, Any

import tyro

from coop.common.registry import Registry
from coop.common.settings.methods import METHODS
from coop.common.settings.policies import EVICTIONS, SAMPLERS
from coop.common.settings.reading import Read


def _known(registry: Registry[Any]) -> Read:
    def check(name: Any) -> Any:  # noqa: ANN401 (another type is refused with those of other fields)
        if isinstance(name, str) and not registry.knows(name):
            raise ValueError(registry.unknown(name))
        return name

    return Read(check)


def _shown(registry: Registry[Any]) -> object:
    return tyro.conf.arg(metavar=f"{{{','.join(registry.names())}}}")


MethodName = Annotated[str, _known(METHODS)]
EvictionName = Annotated[str, _known(EVICTIONS), _shown(EVICTIONS)]
SamplingName = Annotated[str, _known(SAMPLERS), _shown(SAMPLERS)]
