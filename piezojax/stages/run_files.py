"""Files with the samples of runs on a stage."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..core.files import atomic_replacement

Samples = Float[np.ndarray, " samples"]

COLUMNS = "reference_um", "measured_um", "voltage_V"
"""Names of the arrays in the file of a run."""


def run_file(folder: Path, number: int) -> Path:
    """Return the file of run ``number`` in ``folder``."""
    return folder / f"run_{number:02d}.npz"


def run_files(folder: Path) -> list[Path]:
    """Return the files of the runs in ``folder``, in the order of their numbers."""
    return sorted(folder.glob("run_*.npz"), key=lambda file: int(file.stem[4:]))


def save_samples(
    file: Path, reference: Samples, measured: Samples, voltage: Samples
) -> None:
    """Write the samples of a run, um and V, into ``file``."""
    with atomic_replacement(file) as temporary, temporary.open("wb") as stream:
        columns = reference, measured, voltage
        np.savez(stream, **dict(zip(COLUMNS, columns, strict=True)))


def load_samples(file: Path) -> tuple[Samples, Samples, Samples]:
    """Return reference, reading (um) and voltage (V) of the run in ``file``."""
    with np.load(file, allow_pickle=False) as samples:
        reference, measured, voltage = (samples[name] for name in COLUMNS)
    return reference, measured, voltage
