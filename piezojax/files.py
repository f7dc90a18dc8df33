"""Writing results: never over older ones, never half a file."""

import os
import tempfile
from pathlib import Path


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` in one move: a killed run leaves the old file."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path`` in one move.

    Raises ValueError if its folder is missing or cannot be written.
    """
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(name, 0o644)  # mkstemp makes it private
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def fresh_folder(path: Path) -> Path:
    """Make ``path`` for new results and return it.

    Raises ValueError if it already holds something or cannot be written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        occupied = any(path.iterdir())
        if not occupied:
            (path / ".probe").touch()
            (path / ".probe").unlink()
    except OSError as error:
        raise ValueError(f"--out {path} cannot be written: {error.strerror}") from None
    if occupied:
        raise ValueError(f"--out {path} already holds results; name a new folder")
    return path


def numbered_folder(stem: Path) -> Path:
    """Return ``stem``, or ``stem-2``, ``stem-3``, ...: the first that is still free."""
    number = 1
    while True:
        path = stem if number == 1 else stem.with_name(f"{stem.name}-{number}")
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return path
        number += 1
