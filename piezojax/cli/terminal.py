"""Terminal output of a command: console and progress."""

import os
import sys
import time
from contextlib import ExitStack, suppress
from types import FrameType
from typing import TextIO

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

from .stopping import SIGNALS, handled, remember

NOTE_EVERY = 30.0
"""Shortest time between two printed notes without a terminal, s."""

_STOPPING = "stopping; Ctrl-C again stops at once"

PIPED = 200
"""Width of tables without a terminal, unless COLUMNS is set: no column is cut."""


class Bar:
    """Progress bar on a terminal; plain lines without one.

    While it runs, the first Ctrl-C or SIGTERM waits for the next report of progress,
    because an exception inside JAX's compiler can be lost or can crash the compiler.
    The second acts at once. With ``at_once`` the first also acts at once: a stage that
    moves must not wait.
    """

    def __init__(self, console: Console, at_once: bool = False):
        self._console, self._at_once = console, at_once
        self._live = console.is_terminal
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
            disable=not self._live,
        )
        self._task = None
        self._interrupted = False
        self._finishing = False
        self._stack = ExitStack()
        self._noted = time.monotonic()

    def __enter__(self) -> "Bar":
        self._stack.enter_context(handled(dict.fromkeys(SIGNALS, self._interrupt)))
        self._progress.start()
        return self

    def __exit__(self, *exception) -> None:
        self._progress.stop()
        self._stack.close()

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        remember(number)
        if self._interrupted or (self._at_once and not self._finishing):
            raise KeyboardInterrupt
        self._interrupted = True
        if not self._live and not self._console.quiet:
            # A handler may run inside another print, so it cannot print itself.
            with suppress(OSError):
                os.write(self._console.file.fileno(), f"{_STOPPING}\n".encode())
        if self._task is not None:
            self._progress.update(self._task, note=_STOPPING)

    def finish(self) -> None:
        """Ignore the first Ctrl-C or SIGTERM, even a pending one, from here on.

        The work is complete, and its results are written next.
        """
        self._finishing = True

    def _raise_if_interrupted(self) -> None:
        if self._interrupted and not self._finishing:
            self._interrupted = False
            raise KeyboardInterrupt

    def stage(self, text: str, steps: int = 0) -> None:
        """Show a new stage of ``steps`` steps; 0 if their number is unknown."""
        self._raise_if_interrupted()
        if not self._live:
            self._console.print(text)
        if self._task is not None:
            self._progress.update(self._task, total=1, completed=1)
        self._task = self._progress.add_task(text, total=steps or None, note="")

    def advance(self, best: float, note: str = "") -> None:
        """Move the bar by one step.

        Without a terminal, print ``note`` at most every ``NOTE_EVERY`` seconds.
        """
        self._raise_if_interrupted()
        if self._task is not None:
            shown = note or f"objective {best:.3f}"
            self._progress.update(self._task, advance=1, note=shown)
        now = time.monotonic()
        if note and not self._live and now - self._noted > NOTE_EVERY:
            self._console.print(note)
            self._noted = now


def console(quiet: bool, file: TextIO | None = None) -> Console:
    """Return the console of a command, on standard output or ``file``."""
    # Titles and paths may contain brackets, so nothing printed is markup.
    file = file or sys.stdout
    found = Console(quiet=quiet, file=file, highlight=False, markup=False)
    if not found.is_terminal and "COLUMNS" not in os.environ:
        found.width = PIPED
    return found
