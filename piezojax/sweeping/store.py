"""Folder of a sweep: its manifest, and one file for each finished chunk."""

import hashlib
import json
import math
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..core.files import write_bytes, write_text
from ..core.serial import to_data
from ..core.temporaries import remove_stale
from .simulator import Simulator

MANIFEST, CHUNKS, RESULT = "manifest.json", "chunks", "sweep.nc"
"""Names in the folder of a sweep."""

VERSIONED = ("piezojax", "jax", "jaxlib", "numpy", "scipy")

# Digits of numbers in the fingerprint; the last digits differ between machines.
_DIGITS = 9


def identity_of(simulator: Simulator) -> dict[str, Any]:
    """Return all settings that determine the results of a sweep, as plain data."""
    case, plan = simulator.case, simulator.plan
    systems = {
        "controller": case.loop.controller,
        "actuator": case.loop.actuator,
        "sensor": case.loop.sensor,
        **{f"plant {name}": plant for name, plant in simulator.plants.items()},
    }
    built = {name: _rounded(to_data(system)) for name, system in systems.items()}
    return {
        "study": case.study.model_dump(mode="json", exclude_none=True),
        "files": list(case.contents),
        "systems": _hash(built),
        "points": _hash(_rounded(plan.values(0, min(plan.points, 4096)).tolist())),
        "plan": {
            "shape": list(plan.shape),
            "points": plan.points,
            "chunk": plan.chunk,
            "chunks": plan.chunks,
            "width": plan.width,
        },
        "versions": {n: version(n) for n in VERSIONED},
        "platform": jax.default_backend(),
    }


def _hash(data: Any) -> str:
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _rounded(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _rounded(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_rounded(value) for value in data]
    return f"{data:.{_DIGITS}g}" if isinstance(data, float) else data


class Store:
    """Finished chunks of one sweep, in a folder that several processes may share.

    A chunk is written to a temporary file, flushed to the disk and renamed, so that it
    is either complete or missing. A chunk written again holds the same results.
    """

    def __init__(self, folder: Path, identity: dict[str, Any]):
        self.folder, self.identity = folder, identity
        self.fingerprint = _hash(identity)

    def open(self) -> None:
        """Create the folder, or open it to continue the sweep.

        Raises ValueError if the folder cannot be written, holds other files, or holds a
        sweep with other settings.
        """
        manifest = self.folder / MANIFEST
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            remove_stale(self.folder)
            others = [
                path.name
                for path in self.folder.iterdir()
                if path.name != CHUNKS and not path.name.startswith(".")
            ]
        except OSError as error:
            raise ValueError(
                f"--out {self.folder} cannot be written: {error.strerror}"
            ) from None
        if manifest.exists():
            self._compare(manifest)
        elif others:
            raise ValueError(
                f"--out {self.folder} already holds results that are not of a sweep; "
                "name a new folder"
            )
        else:
            content = {"fingerprint": self.fingerprint, **self.identity}
            write_text(manifest, json.dumps(content, indent=2) + "\n")
        (self.folder / CHUNKS).mkdir(exist_ok=True)

    def _compare(self, manifest: Path) -> None:
        try:
            stored = json.loads(manifest.read_text(encoding="utf-8"))
            same = stored["fingerprint"] == self.fingerprint
        except (OSError, ValueError, KeyError, TypeError):
            raise ValueError(
                f"{manifest} is damaged; name a new folder with --out"
            ) from None
        if same:
            return
        differing = [k for k in self.identity if stored.get(k) != self.identity[k]]
        if "study" in differing and isinstance(stored.get("study"), dict):
            own, old = self.identity["study"], stored["study"]
            tables = [k for k in {**old, **own} if old.get(k) != own.get(k)]
            differing = [f"study.{key}" for key in tables]
        raise ValueError(
            f"--out {self.folder} holds another sweep (it differs in "
            f"{', '.join(differing) or 'its fingerprint'}); name a new folder"
        )

    def path(self, chunk: int) -> Path:
        """Return the path of the file of a chunk."""
        return self.folder / CHUNKS / f"{chunk:08d}.chunk"

    def write(self, chunk: int, arrays: dict[str, np.ndarray], seconds: float) -> None:
        """Store a chunk, which took ``seconds`` of one core or device."""
        payload = b"".join(
            np.ascontiguousarray(array, dtype="<f8").tobytes()
            for array in arrays.values()
        )
        header = {
            "fingerprint": self.fingerprint,
            "chunk": chunk,
            "seconds": seconds,
            "shapes": {name: list(array.shape) for name, array in arrays.items()},
        }
        content = json.dumps(header).encode() + b"\n" + payload
        checksum = hashlib.sha256(content).hexdigest().encode()
        write_bytes(self.path(chunk), checksum + b"\n" + content, durable=True)

    def read(self, chunk: int) -> tuple[dict[str, np.ndarray], float] | None:
        """Return a chunk and its seconds, or None if it is missing or damaged.

        Raises ValueError for a chunk of another sweep.
        """
        path = self.path(chunk)
        try:
            checksum, _, content = path.read_bytes().partition(b"\n")
        except OSError:
            return None
        if hashlib.sha256(content).hexdigest().encode() != checksum:
            return None
        first, _, payload = content.partition(b"\n")
        header = json.loads(first)
        if (header["fingerprint"], header["chunk"]) != (self.fingerprint, chunk):
            raise ValueError(
                f"{path} belongs to another sweep, or to another place in this one; "
                "delete it, or name a new folder with --out"
            )
        arrays, flat = {}, np.frombuffer(payload, dtype="<f8")
        for name, shape in header["shapes"].items():
            count = math.prod(shape)
            arrays[name], flat = flat[:count].reshape(shape), flat[count:]
        return arrays, float(header["seconds"])

    def missing(self, chunks: Iterable[int]) -> list[int]:
        """Return the missing or damaged ones of ``chunks``.

        Raises ValueError as ``read`` does.
        """
        return [chunk for chunk in chunks if self.read(chunk) is None]

    def exist(self, chunks: Iterable[int]) -> bool:
        """Return whether the files of all ``chunks`` exist, without reading them."""
        return all(self.path(chunk).exists() for chunk in chunks)
