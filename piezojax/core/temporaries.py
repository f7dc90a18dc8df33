"""Temporary files named after their process, and removal of those left by dead ones."""

import os
import re
import secrets
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FOREIGN = 86_400.0
"""Age (s) above which the file of a process on another machine counts as left over."""

_HOST = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:32] or "host"
_NAME = re.compile(
    r"\..+\.(?P<host>[A-Za-z0-9-]+)\.(?P<process>\d+)\.[0-9a-f]{8}\.part"
)
_CLAIM = "running"

_own: set[Path] = set()


@contextmanager
def temporary(path: Path) -> Iterator[Path]:
    """Create an empty temporary file beside ``path``, and delete it at the end.

    Its name contains the machine and the process, so that ``remove_stale`` knows
    whether it is still in use. Raises OSError if the folder cannot be written.
    """
    name = f".{path.name}.{_HOST}.{os.getpid()}.{secrets.token_hex(4)}.part"
    beside = (path.parent / name).absolute()
    _own.add(beside)
    try:
        beside.touch(mode=0o600, exist_ok=False)
        yield beside
    finally:
        beside.unlink(missing_ok=True)
        _own.discard(beside)


@contextmanager
def claimed(folder: Path) -> Iterator[bool]:
    """Mark ``folder`` as in use; yield whether it is otherwise empty.

    Of several processes that claim an empty folder at the same time, at most one
    receives True. Raises OSError if the folder cannot be written.
    """
    with temporary(folder / _CLAIM) as claim:
        yield all(entry.absolute() == claim for entry in folder.iterdir())


def is_claimed(folder: Path) -> bool:
    """Return whether another process, or another part of this one, uses ``folder``."""
    return any(not _is_stale(path) for path in folder.glob(f".{_CLAIM}.*.part"))


def remove_stale(folder: Path) -> None:
    """Delete the temporary files of ended processes, two folders deep at most."""
    for pattern in (".*.part", "*/.*.part", "*/*/.*.part"):
        for path in filter(_is_stale, folder.glob(pattern)):
            with suppress(OSError):  # a file of another user
                path.unlink(missing_ok=True)


def _is_stale(path: Path) -> bool:
    match = _NAME.fullmatch(path.name)
    if match is None or path.absolute() in _own:
        return False
    if match["host"] != _HOST or os.name == "nt":  # os.kill ends processes on Windows
        return _age(path) > FOREIGN
    return not _is_running(int(match["process"]))


def _age(path: Path) -> float:
    try:
        return time.time() - path.stat().st_mtime
    except OSError:
        return 0.0


def _is_running(process: int) -> bool:
    """Return whether another ``process`` of this machine is running.

    Process numbers restart in a container: a file that has the number of this
    process, but is not its own, belongs to an earlier process.
    """
    if process == os.getpid():
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
