"""Settings that may change when a run goes on."""

from typing import Final

#: Settings of a run that do not change its training.
CHANGEABLE: Final = frozenset({"device", "threads", "stop_after"})
