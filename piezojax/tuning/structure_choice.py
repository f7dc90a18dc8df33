"""Choice among structures: the fewest notches that are worth their parameters."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel

ERRORS = 2.0
"""Standard errors by which further notches must lower the error to be worth it."""

ATTENUATION = 0.7
"""Gain of a notch at its mode below which it acts on the mode."""


LIMITING = 0.1
"""Least contribution of a mode to |L| that may limit a loop: a smaller one changes |S|
by less than a ninth, where |1 + L| is at least 1 without the mode."""


class ModeInLoop(BaseModel):
    """Mode of the plant in a tuned loop; ``frequency_Hz`` is its natural frequency.

    ``part_of_loop_gain`` is the modulus of the mode's term in L there, ``sensitivity``
    the largest |S| around it, and ``notch`` the gain of the notches there. The first
    two are None if the loop could not be linearised.
    """

    frequency_Hz: float  # noqa: N815
    damping: float
    part_of_loop_gain: float | None
    sensitivity: float | None = None
    notch: float = 1.0


class Structure(BaseModel):
    """Tuned structure: its notches, and its figures on the hold-out.

    ``notches_Hz`` are the frequencies of the tuned notches, and ``at_Hz`` those of the
    modes at which they were placed. ``parameters`` is the number of tuned parameters.
    ``error_um`` and ``worst_um`` are the median and the largest error of the held-out
    plants, or the geometric mean and the largest error of the references if there are
    no such plants; None if a run diverges or stays at a voltage limit. ``log_errors``
    are the logarithms of these errors (um), None where a run is lost.
    ``sensitivity_peak`` is the largest on the plants of the hold-out, or the exact one
    of the nominal plant. ``needless`` are the modes of ``at_Hz`` that contribute too
    little to |L| to limit the loop, even with their notch switched off. ``alarms``
    counts the reasons not to use the gains, ``gains`` holds them by path, and
    ``reason`` tells why the structure was chosen or not.
    """

    notches: int
    at_Hz: list[float]  # noqa: N815
    notches_Hz: list[float] = []  # noqa: N815
    parameters: int = 0
    error_um: float | None = None
    worst_um: float | None = None
    sensitivity_peak: float | None = None
    alarms: int = 0
    needless: list[float] = []
    log_errors: list[float | None] = []
    modes: list[ModeInLoop] = []
    gains: dict[str, float] = {}
    wall_s: float = 0.0
    chosen: bool = False
    reason: str = ""

    @property
    def idle(self) -> list[float]:
        """Frequencies (Hz) of modes whose notch does not attenuate them enough."""
        acted = {m.frequency_Hz: m.notch for m in self.modes}
        return [f for f in self.at_Hz if acted.get(f, 1.0) > ATTENUATION]


class StructureSearch(BaseModel):
    """Structures that were tuned, with the ``criterion`` of the choice among them."""

    criterion: str
    structures: list[Structure]


class Gain(NamedTuple):
    """Mean of ln(error of one structure / error of another), and its standard error."""

    mean: float
    standard_error: float


def criterion_text(worth: float) -> str:
    """Return the criterion of ``choose`` in one sentence."""
    return (
        "the fewest notches to which no larger number is preferred; each further notch "
        f"must lower the error on the hold-out by more than {100.0 * worth:g} %, all "
        f"by more than {ERRORS:g} standard errors, and each must act on a mode "
        "that is large enough to limit the loop"
    )


def gain_of(smaller: Structure, larger: Structure) -> Gain:
    """Return the improvement by ``larger``, from pairs of errors on the same plants.

    Pairs with a lost run are left out; without any pair the gain is 0. With a single
    pair the standard error is 0.
    """
    pairs = [
        one - other
        for one, other in zip(smaller.log_errors, larger.log_errors, strict=True)
        if one is not None and other is not None
    ]
    if not pairs:
        return Gain(0.0, 0.0)
    spread = float(np.std(pairs, ddof=1)) if len(pairs) > 1 else 0.0
    return Gain(float(np.mean(pairs)), spread / math.sqrt(len(pairs)))


def is_worth(smaller: Structure, larger: Structure, worth: float) -> bool:
    """Return whether the further notches of ``larger`` are worth their parameters."""
    gain = gain_of(smaller, larger)
    further = larger.notches - smaller.notches
    return gain.mean > max(-further * math.log1p(-worth), ERRORS * gain.standard_error)


def choose(structures: Sequence[Structure], worth: float) -> int | None:
    """Return the index of the structure to use, None if none has been tuned.

    The candidates are the structures with the fewest alarms; among these, if there are
    any, those whose notches all act on a mode. A structure with a needless notch is no
    candidate if the one without that notch is: its lower error is due to the phase of
    the notch, not to the mode. Of the candidates with the same number of notches the
    one with the lowest error is compared.
    """
    tuned = [i for i, one in enumerate(structures) if one.gains]
    stable = [i for i in tuned if structures[i].error_um is not None] or tuned
    if not stable:
        return None
    fewest = min(structures[i].alarms for i in stable)
    usable = [i for i in stable if structures[i].alarms == fewest]
    usable = [i for i in usable if not structures[i].idle] or usable
    among = [set(structures[i].at_Hz) for i in usable]
    usable = [i for i in usable if not _is_replaced(structures[i], among)]
    best: dict[int, int] = {}
    for i in sorted(usable, key=lambda i: structures[i].error_um or math.inf):
        best.setdefault(structures[i].notches, i)
    counts = sorted(best)
    for count in counts:
        larger = [structures[best[more]] for more in counts if more > count]
        one = structures[best[count]]
        if not any(is_worth(one, other, worth) for other in larger):
            return best[count]
    raise AssertionError("nothing is larger than the largest")


def _is_replaced(one: Structure, among: Sequence[set[float]]) -> bool:
    """Return whether ``one`` without a needless notch is ``among`` the candidates."""
    return any(set(one.at_Hz) - {mode} in among for mode in one.needless)


def explain(structures: Sequence[Structure], chosen: int) -> None:
    """Mark the structure at the index ``chosen``, and give each of the others a reason.

    Structures that were not tuned have their reason already.
    """
    best = structures[chosen]
    for i, one in enumerate(structures):
        if i == chosen:
            one.chosen, one.reason = True, "chosen"
        elif one.gains:
            one.reason = _reason(one, best)


def _reason(one: Structure, best: Structure) -> str:
    if one.error_um is None:
        return "the loop is unstable, or a run diverges or stays at a voltage limit"
    if one.alarms > best.alarms:
        return f"{one.alarms} alarms; the chosen structure has {best.alarms}"
    if one.idle:
        shown = ", ".join(f"{frequency:.4g}" for frequency in one.idle)
        return f"no notch acts on the mode at {shown} Hz"
    if one.needless:
        shown = ", ".join(f"{frequency:.4g}" for frequency in one.needless)
        return f"the mode at {shown} Hz is too small to limit the loop"
    gain = gain_of(best, one)
    ratio = math.exp(-gain.mean)
    if one.notches <= best.notches:
        return f"{ratio:.3g} times the error of the chosen one"
    further = one.notches - best.notches
    return (
        f"{ratio:.3g} times the error of the chosen one (standard error "
        f"{gain.standard_error:.2g}): not worth {further} more"
    )
