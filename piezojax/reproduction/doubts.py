"""Which prints may be wrong: every number of the loops, by one rule.

A candidate is one number printed in one place, however many columns it serves: each
gain, weight and filter constant of each parameter table and section, what the
controllers know of the stage (K_e, the hysteresis that is inverted, of a model its DC
gain as a factor on its numerator), the reference model, and the size of each kind of
reference. Every array leaf of every controller belongs to one, but for three: Q acts
through R/Q alone and is left to R, the poles of the models are left to their gain, and
the rest point of the inverse is not printed. No candidates are what is no parameter of
these loops: the sampling rate, the shape and the frequencies of the references, and the
equations themselves. The stage is no print here: it is fitted anyway.

All are factors on print, 1 as printed. Tuned numbers may be two decimal places off,
alpha one (it ends at 1); what was measured or describes a signal, threefold, as the
stage's own quantities.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from ..signals import waveforms as signals
from .cell import Cell

TUNED, ALPHA, DESCRIBED = 100.0, 10.0, 3.0
"""Largest factor on print, or its inverse."""

REFERENCE = "reference"
"""In place of a leaf: the reference itself."""


@dataclass(frozen=True)
class Doubt:
    """A printed number: the name of its leaf, and the cells whose loops hold it.

    Empty ``columns`` or ``kinds`` (of reference) stand for all of them.
    """

    leaf: str
    span: float
    tables: tuple[str, ...]
    columns: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()

    def concerns(self, cell: Cell) -> bool:
        """Return whether the number is part of the cell's loop."""
        return (
            cell.table in self.tables
            and (not self.columns or cell.column in self.columns)
            and (not self.kinds or signals.parse(cell.row)[0] in self.kinds)
        )

    def leaves(self, paths: Iterable[str]) -> list[str]:
        """Return those of a controller's ``paths`` that the number stands in."""
        return [path for path in paths if self.leaf in path.split(".")]


GAINS = ("proportional", "integral", "derivative", "control_weight")

_CHAPTER_5 = ("5-3", "5-5")
_BEHIND = ("inversion", "dob")
_EVERY = (*_CHAPTER_5, "4-5")


def _tuned(place: str, names: Iterable[str], *where: tuple[str, ...]):
    spans = {"alpha": ALPHA}
    return {
        f"{name}, {place}": Doubt(name, spans.get(name, TUNED), *where)
        for name in names
    }


def _described(place: str, name: str, *where: tuple[str, ...]) -> dict[str, Doubt]:
    return {place: Doubt(name, DESCRIBED, *where)}


DOUBTS: dict[str, Doubt] = {
    # Table 5-2 and the sections print one set for all columns, Table 5-4 one a column.
    **_tuned("Table 5-2", GAINS, ("5-3",)),
    **_tuned("Table 5-4, PID-SMC", GAINS, ("5-5",), ("pid_smc",)),
    **_tuned("Table 5-4, inversion", GAINS, ("5-5",), ("inversion",)),
    **_tuned("Table 5-4, observer", GAINS, ("5-5",), ("dob",)),
    **_tuned("5.5.6.2", ("surface", "alpha", "beta"), ("5-3",)),
    **_tuned("5.5.6.2", ("cutoff",), ("5-3",), ("dob",)),
    **_tuned("5.5.6.3", ("surface", "alpha", "beta"), ("5-5",)),
    **_tuned("5.5.6.3", ("cutoff",), ("5-5",), ("dob",)),
    **_described("K_e", "gain", _CHAPTER_5, ("dob",)),
    **_described("DC gain of (5.33)", "moving", _CHAPTER_5, _BEHIND),
    **_described("DC gain of (5.34)", "moving", _CHAPTER_5, ("pid_smc",)),
    **_described("a of the inverse", "a", _CHAPTER_5, ("inversion",)),
    **_described("b of the inverse", "b", _CHAPTER_5, ("inversion",)),
    **_described("c of the inverse", "c", _CHAPTER_5, ("inversion",)),
    **_tuned("Table 4-4", (*GAINS, "surface"), ("4-5",), ("model_reference",)),
    **_described("omega, 4.5.4.3", "frequency", ("4-5",), ("model_reference",)),
    **_described("zeta, 4.5.4.3", "damping", ("4-5",), ("model_reference",)),
    **_described("DC gain, Table 4-1", "moving", ("4-5",), ("model_reference",)),
    **_tuned("continuous, 4.5.4.3", GAINS[:3], ("4-5",), ("continuous",)),
    **_tuned("continuous, 5.5.6.2", ("surface",), ("4-5",), ("continuous",)),
    **_tuned("4.5.4.1", ("alpha", "beta"), ("4-5",)),
    **_described("size of SIN", REFERENCE, _EVERY, (), ("SIN",)),
    **_described("size of PWSW", REFERENCE, _EVERY, (), ("PWSW",)),
    **_described("size of SW", REFERENCE, _EVERY, (), ("SW",)),
}
"""Every candidate by its name."""


def candidates(cells: Iterable[Cell]) -> dict[str, Doubt]:
    """Return the candidates that are part of the loop of any of ``cells``."""
    cells = list(cells)
    return {
        name: doubt
        for name, doubt in DOUBTS.items()
        if any(doubt.concerns(cell) for cell in cells)
    }
