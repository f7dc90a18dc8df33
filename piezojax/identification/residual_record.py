"""Residual of a fitted model over its records, in memory and in a file."""

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.about import About
from ..core.files import write_bytes
from .fit import Fit

Part = Literal["train", "validate"]
"""Part of a record: that of the fit, or that of the validation."""

PARTS: tuple[Part, ...] = ("train", "validate")

SUFFIX = ".residual.npz"
"""Suffix of a residual file, after the stem of the name of its model file."""

EQUAL = 1e-3
"""Largest relative difference of the residual's rms from that in the model's file."""


_UNREADABLE = (
    *(OSError, EOFError, ValueError, KeyError, TypeError, AttributeError),
    zipfile.BadZipFile,
)
"""Errors of NumPy on a file that is no archive of the arrays of a residual."""


class Stretch(NamedTuple):
    """Residual and simulated output over a part of a record, [samples, p]."""

    residual: Float[np.ndarray, "samples p"]
    simulated: Float[np.ndarray, "samples p"]


@dataclass(frozen=True)
class ResidualRecord:
    """Residual and simulated output of a model over its records, by part.

    Each part holds a Stretch of each record that has samples there, in the units of the
    outputs; ``dt`` is the sample time, s.
    """

    dt: float
    parts: dict[Part, tuple[Stretch, ...]]

    @classmethod
    def of(cls, fit: Fit) -> "ResidualRecord":
        """Return the residual of ``fit``: the records minus the free runs."""

        def stretches(part: slice) -> tuple[Stretch, ...]:
            found = [
                Stretch((record.outputs - run)[part], run[part])
                for record, run in zip(fit.records, fit.simulations, strict=True)
            ]
            return tuple(one for one in found if len(one.residual) > 1)

        parts: dict[Part, tuple[Stretch, ...]] = {
            "train": stretches(fit.train),
            "validate": stretches(fit.validate),
        }
        return cls(fit.record.dt, parts)


def residual_path(model: Path) -> Path:
    """Return the path of the residual that belongs to the file ``model``."""
    return model.with_name(model.stem + SUFFIX)


def save_residual(residual: ResidualRecord, model: Path) -> None:
    """Write ``residual`` beside the file ``model``, as plain arrays."""
    arrays: dict[str, np.ndarray] = {"dt": np.array(residual.dt)}
    for part, stretches in residual.parts.items():
        for i, stretch in enumerate(stretches):
            for name, values in stretch._asdict().items():
                arrays[f"{part}_{i}_{name}"] = values
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    write_bytes(residual_path(model), content.getvalue())


def load_residual(model: Path, about: About) -> ResidualRecord | None:
    """Return the residual beside the file ``model``, None if there is none.

    ``about`` is the origin of the model. Raises ValueError for a file that cannot be
    read or is the residual of another model.
    """
    path = residual_path(model)
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        found = ResidualRecord(
            float(arrays["dt"]), {part: _stretches(arrays, part) for part in PARTS}
        )
    except _UNREADABLE:
        raise ValueError(
            f"{path} is not the residual of a model: fit the model again, or delete it"
        ) from None
    validated = [one.residual for one in found.parts["validate"]]
    rms = np.sqrt(np.mean(np.concatenate(validated) ** 2, axis=0))
    known = np.asarray(about.residual_rms)
    same = rms.shape == known.shape and np.allclose(rms, known, rtol=EQUAL, atol=0.0)
    if not same:
        raise ValueError(
            f"{path.name} is the residual of another model than {model.name}: its rms "
            f"is {_shown(rms)}, that of the model {_shown(known)}"
        )
    return found


def _stretches(arrays: dict[str, np.ndarray], part: Part) -> tuple[Stretch, ...]:
    found = []
    while f"{part}_{len(found)}_residual" in arrays:
        both = [
            np.asarray(arrays[f"{part}_{len(found)}_{name}"], float)
            for name in Stretch._fields
        ]
        shapes = {values.shape for values in both}
        if len(shapes) > 1 or both[0].ndim != 2 or not np.all(np.isfinite(both)):
            raise ValueError("residual and motion differ in shape or are not finite")
        found.append(Stretch(*both))
    if not found:
        raise ValueError(f"there is no part {part}")
    return tuple(found)


def _shown(rms: np.ndarray) -> str:
    return ", ".join(f"{value:.4g}" for value in np.ravel(rms)) or "not known"
