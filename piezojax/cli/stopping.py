"""Requests to stop a command: Ctrl-C and SIGTERM."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that ask a command to stop; batch systems and ``timeout`` send SIGTERM."""

Handler = Callable[[int, FrameType | None], Any]

_first: list[int] = []


@contextmanager
def handled(handlers: dict[signal.Signals, Handler]) -> Iterator[None]:
    """Handle signals by ``handlers``; restore the previous handlers at the end.

    Only the main thread may handle signals; in another one nothing changes.
    """
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {n: signal.signal(n, handler) for n, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def terminable() -> Iterator[None]:
    """End the process at once on SIGTERM, with the exit status 143.

    No results are lost while a command imports, reads its files or prints; while
    it computes, ``Bar`` handles the signal.
    """
    _first.clear()
    with handled({signal.SIGTERM: _end}):
        yield


def _end(number: int, frame: FrameType | None) -> NoReturn:
    sys.stderr.write("terminated\n")
    sys.stderr.flush()
    os._exit(128 + number)


def remember(number: int) -> None:
    """Remember ``number``, the signal that interrupts the command."""
    _first.append(number)
    if number == signal.SIGTERM:
        # A second SIGTERM ends the process at once, even inside XLA's compiler: a
        # Python handler would wait for it to return, the default one does not.
        signal.signal(number, signal.SIG_DFL)


def exit_interrupted() -> NoReturn:
    """End an interrupted command: exit status 143 after SIGTERM, 130 after Ctrl-C."""
    raise SystemExit(128 + (_first[0] if _first else signal.SIGINT))
