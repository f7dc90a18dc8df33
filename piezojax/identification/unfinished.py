"""Files of the finished fits of an unfinished search, from which it can continue."""

import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..core.files import read_model, write_bytes, write_report, write_text
from ..core.serial import load, save, to_data
from .estimators.estimate import Options
from .fit import Fit, FitReport
from .ranking import file_name
from .records.parts import longest_first
from .records.record import Record

FOLDER = "search"
"""Folder of the files, inside that of the results."""

KEY = f"{FOLDER}/key.txt"
"""File with the key of the search that the fits belong to."""

Errors = tuple[np.ndarray, ...] | None
"""Errors of a model on records that were left out, None if it fails on one."""


class Finished(NamedTuple):
    """A finished fit; ``across``: its errors on other records, if ``has_across``."""

    fit: Fit
    across: Errors
    has_across: bool


class Unfinished:
    """Fits of a search of ``records`` in ``folder``, written as they are finished.

    ``parts`` are the samples for training, validation and test. Raises ValueError if
    ``folder`` holds fits of a search with other records, parts, options or versions.
    """

    def __init__(
        self,
        folder: Path,
        records: Sequence[Record],
        parts: Sequence[slice | None],
        options: Options,
    ):
        self._results, self._folder = folder, folder / FOLDER
        key = _key(records, parts, options)
        if (folder / KEY).exists():
            if (folder / KEY).read_text(encoding="utf-8").strip() != key:
                raise ValueError(
                    f"{folder} holds an unfinished search with other records, parts, "
                    "options or versions: name another folder"
                )
            return
        self._folder.mkdir()
        write_text(folder / KEY, key + "\n")

    def keep(self, model: str, fit: Fit, across: Errors, has_across: bool) -> None:
        """Write a fit, except one with details for plots or with held dynamics."""
        if fit.linear is not None or fit.held is not None:
            return
        arrays = {f"run_{i}": run for i, run in enumerate(fit.simulations)}
        for i, errors in enumerate(across or ()):
            arrays[f"across_{i}"] = errors
        arrays["count"] = np.array(fit.count)
        arrays["failed"] = np.array(has_across and across is None)
        stem = file_name(model)
        save(fit.system, self._folder / f"{stem}.json", fit.about)
        write_report(self._folder / f"{stem}.fit.json", fit.report)
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        # Last: a fit counts as finished if this file exists.
        write_bytes(self._folder / f"{stem}.npz", content.getvalue())

    def found(
        self, model: str, records: Sequence[Record], train: slice, validate: slice
    ) -> Finished | None:
        """Return the fit of ``model`` from the files.

        None if there is none, or if a file is damaged.
        """
        stem = file_name(model)
        try:
            with np.load(self._folder / f"{stem}.npz", allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            across, failed = _several(arrays, "across"), bool(arrays["failed"])
            fit = Fit(
                load(self._folder / f"{stem}.json", accept_unsafe=True),
                read_model(FitReport, self._folder / f"{stem}.fit.json", "is damaged"),
                longest_first(records),  # as in the fit
                _several(arrays, "run"),
                train,
                validate,
                count=int(arrays["count"]),
            )
        except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
            return None
        return Finished(fit, None if failed else across, failed or bool(across))

    def remove(self) -> None:
        """Remove the files, at the end of the search."""
        shutil.rmtree(self._folder, ignore_errors=True)


def _several(arrays: dict[str, np.ndarray], name: str) -> tuple[np.ndarray, ...]:
    count = sum(key.startswith(f"{name}_") for key in arrays)
    return tuple(arrays[f"{name}_{i}"] for i in range(count))


def _key(
    records: Sequence[Record], parts: Sequence[slice | None], options: Options
) -> str:
    """Return the SHA-256 of all that a fit depends on."""
    known = {
        "versions": [version(name) for name in ("piezojax", "jax", "jaxlib")],
        "parts": [part and (part.start, part.stop) for part in parts],
        "options": [options.order, options.window, options.oversample, options.steps],
        "approach": options.closed_loop,
        "controller": options.controller and to_data(options.controller),
    }
    digest = hashlib.sha256(json.dumps(known, sort_keys=True, default=str).encode())
    for record in records:
        units = record.input_units, record.output_units
        signals = record.inputs, record.outputs, record.reference, record.dither
        shapes = [None if x is None else np.shape(x) for x in signals]
        digest.update(repr((record.dt, units, record.period, shapes)).encode())
        for signal in signals:
            if signal is not None:
                digest.update(np.ascontiguousarray(signal).tobytes())
    return digest.hexdigest()
