"""Files of studies: reading, writing and their checksum."""

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, get_args

import tomli_w
from pydantic import AliasChoices

from ..core.plain import read_plain
from ..core.registry import discover
from .plant_tables import RecordPlant, ResponsePlant
from .schema import Study
from .tables import Table, validated


def _file_keys(kind: Any) -> frozenset[str]:
    """Return the keys that hold paths in the tables of a type, at any depth."""
    if not (isinstance(kind, type) and issubclass(kind, Table)):
        return frozenset().union(*map(_file_keys, get_args(kind)))
    found: set[str] = set()
    for name, field in kind.model_fields.items():
        found |= _file_keys(field.annotation)
        if _is_path(field.annotation):
            alias = field.validation_alias
            names = (
                alias.choices if isinstance(alias, AliasChoices) else [alias or name]
            )
            found |= {str(each) for each in names}
    return frozenset(found)


def _is_path(kind: Any) -> bool:
    return kind is Path or any(map(_is_path, get_args(kind)))


_FILES = _file_keys(Study | RecordPlant | ResponsePlant)
"""Keys of a study whose values name files."""


def as_toml(study: Study, renamed: Callable[[str], str] = str) -> str:
    """Return the text of ``study`` as a file, with every default written out.

    The rms of a measured noise is left out: a Case computes it from the file. Therefore
    the study of a Case and the one from which it was built have the same text.
    ``renamed`` maps the names of files to those in the text.
    """
    content = study.model_dump(mode="json", exclude_none=True)
    if study.sensor.measured_noise is not None:
        del content["sensor"]["noise_rms"]
    return tomli_w.dumps(_with_files(content, renamed))


def _with_files(content: Any, renamed: Callable[[str], str], key: str = "") -> Any:
    if isinstance(content, dict):
        return {name: _with_files(x, renamed, name) for name, x in content.items()}
    if isinstance(content, list):
        return [_with_files(x, renamed, key) for x in content]
    return renamed(content) if key in _FILES and isinstance(content, str) else content


def contents_of(study: Study, folder: Path) -> tuple[str, ...]:
    """Return the SHA-256 of each file that ``study`` names, "" if it cannot be read.

    The names of the files are relative to ``folder``.
    """
    names: list[str] = []
    as_toml(study, lambda name: names.append(name) or name)

    def content_of(name: str) -> str:
        try:
            return hashlib.sha256((folder / name).read_bytes()).hexdigest()
        except OSError:
            return ""

    return tuple(content_of(name) for name in names)


def sha256_of(study: Study, contents: Iterable[str]) -> str:
    """Return the SHA-256 that identifies ``study`` with its files.

    It is that of ``as_toml``, with the folders of file names left out, followed by the
    ``contents_of`` the files. Comments and the folder of the study do not count.
    """
    text = as_toml(study, lambda name: Path(name).name)
    return hashlib.sha256("".join([text, *contents]).encode("utf-8")).hexdigest()


def load(path: str | Path) -> Study:
    """Read and validate a study file; build nothing.

    Raises ValueError: one line with the key, the value and the allowed values.
    """
    path = Path(path)
    discover()  # constraints and stages of other packages
    return validated(Study, read_plain(path, "toml", f"study {path}"), "")
