"""How long work says where it stands; report.console shows it."""

from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """What long work tells while it runs."""

    def stage(self, text: str, steps: int = 0) -> None:
        """Announce a stage that takes ``steps`` advances, or an unknown time."""

    def advance(self, best: float, note: str = "") -> None:
        """Tell that a step is done, and how good the best start is or a note."""


class Silent:
    """No progress."""

    def stage(self, text: str, steps: int = 0) -> None:
        """Say nothing."""

    def advance(self, best: float, note: str = "") -> None:
        """Say nothing."""
