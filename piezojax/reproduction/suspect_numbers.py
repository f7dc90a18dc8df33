"""Candidates for suspect numbers: every printed number of the loops, by one rule.

A candidate is one number that is printed in one place, for any number of columns
that use it. The candidates are:

- each gain, weight and filter constant of each parameter table and section,
- the description of the stage in the controllers: K_e, the inverted hysteresis, and the
  DC gain of each model, as a factor on its numerator,
- the reference model,
- the amplitude of each kind of reference.

Every array leaf of every controller belongs to a candidate, with three exceptions. Q
acts only through R/Q, which R covers. The poles of the models are covered by their
gain. The rest point of the inverse is not printed. The sampling rate, the shapes and
frequencies of the references, and the equations are not candidates, because they are
not parameters of these loops. The stage is not a candidate, because it is fitted
anyway.

A candidate is varied by a factor on its printed value. Its bounds are a factor of 100
in both directions for tuned numbers (10 for alpha, which ends at 1), and 3 for numbers
that were measured or describe a signal, similar to the factors of the fitted stage.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from ..signals import waveforms as signals
from .cell import Cell

TUNED, ALPHA, DESCRIBED = 100.0, 10.0, 3.0
"""Largest factors on a printed value; their inverses are the smallest."""

REFERENCE = "reference"
"""Name of the leaf for a candidate that scales the reference."""


@dataclass(frozen=True)
class SuspectNumber:
    """A printed number that may be wrong.

    ``leaf`` is the name of its leaf in the controller, ``span`` the largest factor on
    it. It appears in the loops of ``tables``, ``columns`` and ``kinds`` of reference;
    empty ``columns`` or ``kinds`` mean all.
    """

    leaf: str
    span: float
    tables: tuple[str, ...]
    columns: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()

    def appears_in(self, cell: Cell) -> bool:
        """Return whether the number appears in the loop of ``cell``."""
        return (
            cell.table in self.tables
            and (not self.columns or cell.column in self.columns)
            and (not self.kinds or signals.parse(cell.row)[0] in self.kinds)
        )

    def leaves(self, paths: Iterable[str]) -> list[str]:
        """Return the ``paths`` of a controller that hold the number."""
        return [path for path in paths if self.leaf in path.split(".")]


GAINS = ("proportional", "integral", "derivative", "control_weight")

_CHAPTER_5 = ("5-3", "5-5")
_BEHIND = ("inversion", "dob")
_EVERY = (*_CHAPTER_5, "4-5")


def _tuned(place: str, names: Iterable[str], *where: tuple[str, ...]):
    spans = {"alpha": ALPHA}
    return {
        f"{name}, {place}": SuspectNumber(name, spans.get(name, TUNED), *where)
        for name in names
    }


def _described(
    place: str, name: str, *where: tuple[str, ...]
) -> dict[str, SuspectNumber]:
    return {place: SuspectNumber(name, DESCRIBED, *where)}


CANDIDATES: dict[str, SuspectNumber] = {
    # Table 5-2 and the sections hold one set for all columns, Table 5-4 one for each.
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
"""Candidates by name."""


def candidates_of(cells: Iterable[Cell]) -> dict[str, SuspectNumber]:
    """Return the candidates that appear in the loop of any of ``cells``."""
    cells = list(cells)
    return {
        name: suspect
        for name, suspect in CANDIDATES.items()
        if any(suspect.appears_in(cell) for cell in cells)
    }
