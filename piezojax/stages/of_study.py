"""Emulated stage and motions of a study."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ..core.serial import load
from ..core.system import Affine, System
from ..dynamics import FractionalDelay
from ..study import Case, Study, read
from ..study.make_case import with_measured_noise
from ..study.make_hardware import driven
from ..study.references import reference_signals
from ..study.trajectories import read_trajectories
from .emulated import EmulatedStage, Limits
from .try_gains import Motion

FULL_SWING = 5e-3
"""Default shortest time in which the voltage may cross its range, s."""

SHARE = 0.25
"""Default largest tracking error, as a share of the range of the references."""

LONGEST_DELAY = 5


def emulated_stage(
    study: str | Path,
    *,
    plant: str | Path | None = None,
    gain: float = 1.0,
    delay: float = 0.0,
    slew: float | None = None,
    largest_error: float | None = None,
    speed: float = 1.0,
    seed: int = 0,
) -> EmulatedStage:
    """Return the stage of a study file, with the plant in the file ``plant`` if given.

    Its displacement is multiplied by ``gain`` and delayed by ``delay`` samples. The
    guard holds the limits of the study's actuator, ``slew`` (V/s) and
    ``largest_error`` (um). Raises ValueError for several axes and in the cases of
    ``study.read``.
    """
    case = read(study)
    _check_axes(case.study)
    (lower,), (upper,) = map(
        case.study.by_axis, (case.study.actuator.lower, case.study.actuator.upper)
    )
    found = _plant(case, plant, gain, delay)
    reach = float(np.ptp(case.references)) or 1.0
    limits = Limits(
        lower,
        upper,
        slew or (upper - lower) / FULL_SWING,
        largest_error or SHARE * reach,
        retreat=min(max(0.0, lower), upper),
    )
    return EmulatedStage(
        case.loop.controller,
        found,
        case.loop.actuator,
        case.loop.sensor,
        limits,
        case.study.dt,
        drift=case.study.by_axis(case.study.disturbance.drift_rms)[0],
        seed=seed,
        speed=speed,
    )


def motions_of(
    study: Study, folder: Path, promised: Mapping[str, float | None]
) -> Sequence[Motion]:
    """Return the references of ``study`` with their ``promised`` errors (um).

    Only those named in ``promised`` are returned. The files that the study names lie in
    ``folder``. Raises ValueError for several axes and for a file that is missing.
    """
    _check_axes(study)
    study, _ = with_measured_noise(study, folder)
    table = study.references
    signals = reference_signals(study, read_trajectories(study, folder))
    noise = study.by_axis(study.sensor.noise_rms)[0]
    rows = zip((*table.tune, *table.unseen), signals, strict=True)
    return [
        Motion(name, signal, promised[name], study.settled, noise)
        for name, signal in rows
        if name in promised
    ]


def _check_axes(study: Study) -> None:
    if study.axes is not None:
        raise ValueError(
            f"the study has {study.axis_count} axes; a stage on which gains are tried "
            "has one"
        )


def _plant(case: Case, file: str | Path | None, gain: float, delay: float) -> System:
    found = case.loop.plant
    if file is not None:
        found = driven(case.amplifier, load(Path(file), accept_unsafe=True))
    if gain != 1.0:
        found = found >> Affine(gain)
    if delay:
        dt = case.study.dt
        found = found >> FractionalDelay(delay * dt, dt, LONGEST_DELAY, order=3)
    return found
