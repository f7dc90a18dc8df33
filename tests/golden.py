"""Reader of the golden vectors of an exported folder."""

import numpy as np


def golden_vectors(folder):
    """Return the rows of ``vectors.csv`` in ``folder``, one for each sample."""
    lines = (folder / "vectors.csv").read_text(encoding="utf-8").splitlines()
    _, names, *rows = (line for line in lines if not line.startswith("#"))
    values = np.array([[float(value) for value in row.split(",")] for row in rows])
    assert values.shape == (len(rows), len(names.split(",")))
    return values
