"""What every role shares: types, configuration, wire format, transport, clients, networks, schedules."""

import sys
from types import TracebackType


def _quiet(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Answer a Ctrl-C that comes while a command is still importing in one line, like every later one."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _quiet
