"""Bouc-Wen oscillator as a Structure, with bounds and starts from a record."""

import numpy as np

from ...core.arrays import as_array
from ...core.space import Range, space_of
from ...hysteresis import BoucWen, HystereticOscillator
from ..records.record import Record
from .structure import Structure

SHARES = (0.25, 0.5, 0.75)
"""Shares of the hysteretic element in the total stiffness, for the starts."""

NU = 1.5
"""Exponent nu of the starts."""

WIDE = 100.0
"""Upper bound of the size of beta_gamma and beta_delta, as a multiple of twice their
size at the starts; their unit depends on nu."""


def bouc_wen(record: Record) -> Structure:
    """Return a mass on a spring, a damper and a Bouc-Wen element, driven by a force.

    The starts divide the stiffness of the best linear oscillator between the spring and
    the element. The element's loop bends within the displacements of the record, in one
    of two shapes. Raises ValueError if the best linear oscillator does not have a
    positive mass and stiffness.
    """
    mass, damping, stiffness = linear_oscillator(record)
    # The bend makes the loop turn over at the typical force and displacement.
    displacement = float(np.std(record.output))
    bend = (0.5 * stiffness * displacement) ** (1.0 - NU) / displacement
    system = HystereticOscillator(
        mass,
        damping,
        0.5 * stiffness,
        BoucWen(0.5 * stiffness, 0.5 * bend, 0.0, NU),
        record.dt,
    )
    space = space_of(
        {
            "mass": Range(0.1 * mass, 10.0 * mass, "log"),
            "damping": Range(1e-3 * abs(damping), 10.0 * abs(damping), "log"),
            "stiffness": Range(0.01 * stiffness, 2.0 * stiffness, "log"),
            "hysteresis.alpha": Range(0.01 * stiffness, 2.0 * stiffness, "log"),
            "hysteresis.beta_gamma": Range(0.0, WIDE * bend),
            "hysteresis.beta_delta": Range(-WIDE * bend, WIDE * bend),
            "hysteresis.nu": Range(0.5, 3.0),
        }
    )
    starts = [
        [mass, 0.5 * damping, (1.0 - share) * stiffness, share * stiffness, g, d, NU]
        for share in SHARES
        for g, d in ((0.5 * bend, 0.5 * bend), (0.5 * bend, -0.5 * bend))
    ]
    units = [np.asarray(space.to_unit(as_array(start))) for start in starts]
    return Structure(system, space, np.stack(units))


def linear_oscillator(record: Record) -> tuple[float, float, float]:
    """Return mass (kg), damping (N s/m), stiffness (N/m) of the best linear oscillator.

    Least squares of ``u = m y'' + c y' + k y`` in the frequency domain, at the
    frequencies of the input. Raises ValueError for a mass or stiffness not above 0.
    """
    u, y = np.fft.rfft(record.input), np.fft.rfft(record.output)
    held = np.abs(u) > HELD * np.max(np.abs(u))
    held[0] = False
    s = 2j * np.pi * np.fft.rfftfreq(record.samples, record.dt)[held]
    columns = np.stack([s**2 * y[held], s * y[held], y[held]], axis=1)
    split = np.concatenate([columns.real, columns.imag])
    target = np.concatenate([u[held].real, u[held].imag])
    mass, damping, stiffness = np.linalg.lstsq(split, target, rcond=None)[0]
    if not (mass > 0.0 and stiffness > 0.0):
        raise ValueError(
            f"{record.source}: the best linear oscillator has mass {mass:g} and "
            f"stiffness {stiffness:g}; both must be above 0"
        )
    return float(mass), float(damping), float(stiffness)


HELD = 0.05
"""Least amplitude of a frequency of the input, as a share of its largest line."""
