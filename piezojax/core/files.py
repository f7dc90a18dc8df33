"""Writing results: never over older ones, never half a file."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

Model = TypeVar("Model", bound=BaseModel)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` in one move: a killed run leaves the old file."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write ``content`` to ``path`` in one move.

    With ``durable`` it is on the disk when this returns, power cuts included. Raises
    ValueError if its folder is missing or cannot be written.
    """
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.chmod(name, 0o644)  # mkstemp makes it private
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    if durable:
        _keep_names(path.parent)


@contextmanager
def written_elsewhere(path: Path) -> Iterator[Path]:
    """Give a file beside ``path`` to write to, moved there, on the disk, at the end."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    try:
        yield Path(name)
        with open(name, "rb+") as file:
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    _keep_names(path.parent)


def _keep_names(folder: Path) -> None:
    """Put the folder's list of names on the disk, where the system can."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return  # Windows opens no folders
    try:
        os.fsync(handle)
    except OSError:
        pass  # nor do some network file systems sync them
    finally:
        os.close(handle)


def read_model(kind: type[Model], path: Path, wrong: str) -> Model:
    """Read a JSON file as ``kind``.

    Raises ValueError, with ``wrong`` said of a file that holds something else.
    """
    try:
        return kind.model_validate_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except ValidationError as error:
        raise ValueError(f"{path} {wrong}: {error.errors()[0]['msg']}") from None


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
