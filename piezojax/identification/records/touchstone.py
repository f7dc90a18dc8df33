"""Touchstone files: scattering parameters of network analysers.

Layout: Touchstone File Format Specification, version 1.1, EIA/IBIS Open Forum.
"""

from pathlib import Path

import numpy as np

from .columns import decoded

SUFFIXES = (".s1p", ".s2p")

_HERTZ = {"HZ": 1.0, "KHZ": 1e3, "MHZ": 1e6, "GHZ": 1e9}
_PLACES = {".s1p": (3, 1), ".s2p": (9, 3)}
"""Numbers in a line, and the place of the response: S11 of one port, S21 of two."""


def touchstone(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the frequencies (Hz) and the response [lines] in a Touchstone file.

    The option line ``# Hz S DB R 50`` gives the unit of the frequencies and the form of
    the numbers: DB and MA with an angle in degrees, RI real and imaginary part. Raises
    ValueError, naming the line, for options or numbers that are not understood.
    """
    try:
        text = decoded(path.read_bytes())
    except OSError as error:
        raise ValueError(f"response {path}: {error.strerror}") from None
    except ValueError:
        raise ValueError(f"response {path} is not a text table") from None
    width, place = _PLACES[path.suffix.lower()]
    scale, form, rows = 1e9, "MA", []
    for number, line in enumerate(text.splitlines(), 1):
        content = line.partition("!")[0].strip()
        if content.startswith("["):
            raise ValueError(f"{path}: line {number}: only version 1 is read")
        if content.startswith("#"):
            scale, form = _options(content[1:].upper().split(), path, number)
        elif content:
            try:
                row = [float(cell) for cell in content.split()]
            except ValueError:
                row = []
            if len(row) != width:
                raise ValueError(
                    f"{path}: line {number} must hold {width} numbers; it is "
                    f"{content[:60]!r}"
                )
            rows.append(row)
    if not rows:
        raise ValueError(f"{path}: there are no lines of numbers in it")
    table = np.array(rows)
    first, second = table[:, place], table[:, place + 1]
    if form == "RI":
        return scale * table[:, 0], first + 1j * second
    size = 10.0 ** (first / 20.0) if form == "DB" else first
    return scale * table[:, 0], size * np.exp(1j * np.deg2rad(second))


def _options(words: list[str], path: Path, number: int) -> tuple[float, str]:
    """Return the factor to Hz and the form of the numbers."""
    scale, form, skip = 1e9, "MA", False
    for word in words:
        if skip:
            skip = False
        elif word in _HERTZ:
            scale = _HERTZ[word]
        elif word in ("DB", "MA", "RI"):
            form = word
        elif word == "R":
            skip = True
        elif word != "S":
            raise ValueError(
                f"{path}: line {number}: option {word} is not read; the line must be "
                "as # Hz S DB R 50, with DB, MA or RI"
            )
    return scale, form
