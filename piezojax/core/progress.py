"""Progress reporting interface; ``cli.terminal`` displays it."""

from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Receiver of progress reports from a long computation."""

    def stage(self, text: str, steps: int = 0) -> None:
        """Begin the stage ``text`` of ``steps`` steps; 0 if their number is unknown."""

    def advance(self, best: float, note: str = "") -> None:
        """Report that a step is done, with the best loss so far or a note."""


class Silent:
    """Receiver that ignores progress reports."""

    def stage(self, text: str, steps: int = 0) -> None:
        """Do nothing."""

    def advance(self, best: float, note: str = "") -> None:
        """Do nothing."""
