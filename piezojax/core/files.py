"""Atomic writing of files, reading of models, and new folders for results."""

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from .temporaries import is_claimed, remove_stale, temporary

Model = TypeVar("Model", bound=BaseModel)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` atomically: a killed run leaves the old file."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` to ``path`` as JSON, atomically.

    A number that JSON cannot hold, NaN or infinity, is written as null.
    """
    write_text(path, json.dumps(_for_json(content), indent=2, allow_nan=False) + "\n")


def _for_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _for_json(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_for_json(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_bytes(path: Path, content: bytes, *, durable: bool = False) -> None:
    """Write ``content`` to ``path`` atomically.

    With ``durable`` the file is synced to the disk before the function returns, so that
    it survives a power cut. Raises ValueError if the folder of ``path`` is missing or
    cannot be written.
    """
    with _moved_to(path, durable) as file:
        file.write_bytes(content)


@contextmanager
def atomic_replacement(path: Path) -> Iterator[Path]:
    """Yield a temporary file; at the end, sync it and move it to ``path``.

    Raises ValueError as ``write_bytes`` does.
    """
    with _moved_to(path, durable=True) as file:
        yield file


@contextmanager
def _moved_to(path: Path, durable: bool) -> Iterator[Path]:
    with ExitStack() as stack:
        try:
            file = stack.enter_context(temporary(path))
        except OSError as error:
            raise ValueError(f"{path}: {error.strerror}") from None
        yield file
        if durable:
            with open(file, "rb+") as written:
                os.fsync(written.fileno())
        os.chmod(file, 0o644)  # a temporary file is readable by its owner alone
        os.replace(file, path)
    if durable:
        _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Sync the list of names in ``folder`` to the disk, if the system supports it."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return  # Windows cannot open a folder
    try:
        os.fsync(handle)
    except OSError:
        pass  # some network file systems cannot sync a folder
    finally:
        os.close(handle)


def write_report(path: Path, report: BaseModel) -> None:
    """Write ``report`` to ``path`` as JSON, atomically; ``read_model`` reads it."""
    write_text(path, report.model_dump_json(indent=2) + "\n")


def read_model(kind: type[Model], path: Path, wrong: str) -> Model:
    """Read a JSON file as a model of class ``kind``.

    Raises ValueError for a file that cannot be read, and for a file with other content;
    the message then contains ``wrong``.
    """
    try:
        return kind.model_validate_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except ValidationError as error:
        raise ValueError(f"{path} {wrong}: {error.errors()[0]['msg']}") from None


def seen_from(folder: Path, file: Path) -> str:
    """Return the path of ``file`` relative to ``folder``, or absolute without one."""
    file = file.resolve()
    try:
        return Path(os.path.relpath(file, folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return file.as_posix()


def fresh_folder(path: Path) -> Path:
    """Create the folder ``path`` for new results and return it.

    Temporary files of killed runs in it are deleted. Raises ValueError if the folder is
    not empty, is claimed by a running process, or cannot be written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        remove_stale(path)
        if is_claimed(path):
            raise ValueError(f"--out {path} is in use by a running command")
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
    """Return the first empty or missing folder of ``stem``, ``stem-2`` and so on.

    Temporary files of killed runs in these folders are deleted.
    """
    number = 1
    while True:
        path = stem if number == 1 else stem.with_name(f"{stem.name}-{number}")
        if path.is_dir():
            remove_stale(path)
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return path
        number += 1
