"""Export of a controller or a plant."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..core.about import About
from ..core.axes import PerAxis
from ..core.feedback import Observation
from ..core.files import write_report
from ..core.serial import from_data
from ..core.system import System, accepts, rest_output
from ..hardware import Saturation
from .biquads import write_biquads
from .c_export import write_c
from .compiled_loop import Runs
from .driven import Driven, Seen
from .fmu import write_fmu
from .judge import judge
from .linear_models import write_linear
from .slots import Interface
from .vendor import write_vendor

FAR = 1e6
"""A voltage beyond the limits of every actuator, V."""

HELD = 50
"""Samples between the corners of the piecewise linear test input of a plant."""

AXES = 6
"""Largest number of axes of an exported System."""

UNJUDGED = "no study has judged the stability of this controller"

FORMS = ("c", "fmu", "mat", "octave", "biquads", "vendor")
"""Formats of an export: the values of the option ``to``."""

REPORT = "report.json"
"""File name of the report on a judged controller."""

Limits = Sequence[tuple[float, float]]


def export(
    system: System,
    folder: str | Path,
    *,
    to: str = "c",
    name: str | None = None,
    about: About | None = None,
    limits: Limits | None = None,
    precision: str = "double",
    samples: int = 2000,
    seed: int = 0,
    before: str | Path | None = None,
    accept_unsafe: bool = False,
    runs: Runs | None = None,
) -> list[Path]:
    """Write ``system`` to a new ``folder``; return the paths of its files.

    ``to`` is "c", C99 with its own test; "fmu", an FMU 2.0 for co-simulation; "mat" or
    "octave", the model linearised at rest for MATLAB or Octave; "biquads", the linear
    feedback of a controller as second-order sections; or "vendor", the parameters of an
    E727, NV200 or Stabilizer in the file format of the vendor. ``before`` is a file
    saved from that device; the export compares the values and keeps a copy.

    A controller is exported with its actuator: a saturation at ``limits``, the lowest
    and highest voltage of each axis (V), or without them the actuator of ``about``. As
    in the simulated loop, the applied voltage is fed back to the controller. A plant is
    exported alone. ``name`` is the prefix of files and C names, by default "controller"
    or "plant". The golden vectors have ``samples`` samples, for a plant rounded down to
    a multiple of ``HELD``, and random draws from ``seed``. The reference of a
    controller covers the range that the gains were tuned for, then three times that
    range.

    ``precision`` is "double", "float", or "compensated": float whose sums carry their
    rounding errors. With ``runs`` (``piezojax.tuning.exported_runs.make_runs``), a
    controller in C is also compiled and judged in the simulated loop. The last path is
    then the report, and "float" becomes "compensated" if float costs too much. If the
    compiled loop diverges, the files begin with this alarm, which the report has, too.

    Raises ValueError for a ``folder`` in use, an unknown ``to``, a System with alarms
    (``about.unsafe``) or a controller without margins (``about.judged``) unless
    ``accept_unsafe``, a controller without limits, a System that cannot be written in
    scalar operations, and too few ``samples`` (a controller needs at least 1, a plant
    twice ``HELD``). An FMU, a linear model and biquads need a sampling rate; an FMU
    also needs a C compiler.
    """
    if to not in FORMS:
        raise ValueError(f"to is {to!r}: choose from {', '.join(FORMS)}")
    if before is not None and to != "vendor":
        raise ValueError("before is a file of a device: it needs to='vendor'")
    about = about or About()
    kind, axes = _kind_of(system)
    about = about.model_copy(update={"unsafe": _alarms(kind, about)})
    if not accept_unsafe:
        about.require_safe(
            type(system).__name__,
            "to export it all the same, pass accept_unsafe=True (--accept-unsafe)",
        )
    if to == "vendor":
        saved = None if before is None else Path(before)
        return write_vendor(system, Path(folder), name or kind, about, saved)
    least = 2 * HELD if kind == "plant" else 1
    if samples < least:
        raise ValueError(f"samples is {samples}; a {kind} needs at least {least}")
    draw = np.random.default_rng(seed)
    if kind == "plant":
        system, interface, inputs = _plant(system, axes, about, samples, draw)
    else:
        system, interface, inputs = _controller(
            Driven(system, _actuator(axes, limits, about)), axes, about, samples, draw
        )
    name = name or kind
    if to != "c" and precision != "double":
        raise ValueError(f"the numbers of {to} are double; leave out precision")
    if to in ("mat", "octave"):
        return write_linear(system, interface, Path(folder), name, about, to)
    if to == "biquads":
        return write_biquads(system, interface, Path(folder), name, about)
    if to == "fmu":
        return write_fmu(system, interface, Path(folder), name, about)
    report = None
    if runs is not None and isinstance(system, Driven):
        report = judge(system, interface, runs, precision)
        precision = report.written
        about = about.model_copy(update={"unsafe": [*about.unsafe, *report.alarms]})
    folder = Path(folder)
    files = write_c(system, interface, inputs, folder, name, about, precision)
    if report is not None:
        files.append(folder / REPORT)
        write_report(files[-1], report)
    return files


def export_alarms(system: System, about: About) -> list[str]:
    """Return the reasons not to export ``system``, a sentence each.

    They are the alarms of its file, and one for a controller that no study has judged.
    """
    return _alarms(_kind_of(system)[0], about)


def _alarms(kind: str, about: About) -> list[str]:
    unjudged = kind == "controller" and not about.judged
    return [*about.unsafe, *([UNJUDGED] if unjudged else [])]


def _kind_of(system: System) -> tuple[str, int]:
    """Return "plant" or "controller", and the number of axes, 0 for scalar signals.

    A plant takes a voltage for each axis, a controller an Observation. Raises
    ValueError for a System that takes neither.
    """
    for axes in range(AXES + 1):
        if accepts(system, _signal(np.zeros(max(axes, 1)), axes)):
            return "plant", axes
    for axes in range(AXES + 1):
        signal = _signal(np.zeros(max(axes, 1)), axes)
        if accepts(system, Observation(signal, signal, signal, signal)):
            return "controller", axes
    raise ValueError(
        f"a {type(system).__name__} takes neither the observation of a controller nor "
        f"up to {AXES} voltages; only those can be exported"
    )


def _signal(values: Any, axes: int) -> Any:
    """Return ``values`` [..., axes] as a tuple of one signal per axis.

    With 0 ``axes``, return the only column of ``values`` as a scalar signal.
    """
    if not axes:
        return jnp.asarray(values[..., 0])
    return tuple(jnp.asarray(values[..., axis]) for axis in range(axes))


def _actuator(axes: int, limits: Limits | None, about: About) -> System:
    """Return a saturation at ``limits`` (V), by default the actuator of ``about``."""
    if limits is None and about.actuator is not None:
        return from_data(about.actuator, "about.actuator")
    count = max(axes, 1)
    if limits is None or len(limits) != count:
        raise ValueError(
            "the limits of the voltage are unknown: give the lowest and the highest of "
            f"each of {count} axes (--limits)"
        )
    parts = tuple(Saturation(*each) for each in limits)
    return PerAxis(parts) if axes else parts[0]


def _controller(
    system: Driven, axes: int, about: About, samples: int, draw: np.random.Generator
) -> tuple[System, Interface, Any]:
    """Return a controller with its actuator, its signals, and its test inputs."""
    count = max(axes, 1)
    ends = np.array(about.reference_ranges or [(-1.0, 1.0)] * count)
    middle, half = ends.mean(axis=1), 0.5 * np.ptp(ends, axis=1)
    k = np.arange(samples + 1)[:, None]
    swing = np.sin(2.0 * np.pi * (k / 397.0 + np.arange(count) / 7.0))
    swing = np.where(k > 10, swing * np.where(k > samples // 2, 3.0, 1.0), 0.0)
    reference = middle + half * swing
    measured = np.concatenate([reference[:2], reference[:-2]])
    measured = measured + 1e-2 * half * draw.standard_normal(measured.shape)
    inputs = Seen(
        *(_signal(x[:samples], axes) for x in (reference, reference[1:], measured))
    )
    rest = _signal(middle, axes)
    lowest, highest = (
        rest_output(system.actuator, _signal(np.full(count, end), axes))
        for end in (-FAR, FAR)
    )
    voltage = jax.tree.map(lambda a, b: 0.5 * (a + b), lowest, highest)
    start = Observation(rest, rest, rest, voltage)
    return system, Interface(start, _first(inputs)), inputs


def _plant(
    system: System,
    axes: int,
    about: About,
    samples: int,
    draw: np.random.Generator,
) -> tuple[System, Interface, Any]:
    """Return a plant, its signals, and its test inputs.

    The tests begin at rest in the middle of the input range.
    """
    count = max(axes, 1)
    ends = np.array(about.input_ranges or [(0.0, 100.0)] * count)
    steps = draw.uniform(ends[:, 0], ends[:, 1], (samples // HELD, count))
    steps[0] = ends.mean(axis=1)  # the operating point of a linear export
    held = np.repeat(steps, HELD, axis=0)
    ramp = np.linspace(0.0, 1.0, HELD)[:, None]
    held[HELD:] = np.concatenate(
        [a + ramp * (b - a) for a, b in itertools.pairwise(steps)]
    )
    inputs = _signal(held, axes)
    first = _first(inputs)
    return system, Interface(first, first), inputs


def _first(tree: Any) -> Any:
    return jax.tree.map(lambda x: x[0], tree)
