"""Linear models for other programs: python-control, MATLAB and Octave."""

import io
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..core.about import About
from ..core.files import fresh_folder, write_bytes, write_text
from ..core.system import System, resolve
from ..dynamics.linearise import linearise
from ..dynamics.state_space import StateSpace
from .slots import Interface, slots

SUBJECT = "Model linearised at rest"

LINES = 500
"""Number of frequencies of the exported frequency response."""


def write_linear(
    system: System,
    interface: Interface,
    folder: Path,
    name: str,
    about: About,
    to: str,
) -> list[Path]:
    """Write ``system``, linearised at rest, to the new ``folder``; return the path.

    The operating point is that of ``interface``: the state at rest under its ``start``,
    and its ``input``. ``to`` is "mat", a MATLAB file that SciPy also reads, or
    "octave", a function for MATLAB and Octave that returns the model. Both hold A, B,
    C, D, the sampling time, and the names of inputs and outputs. The MATLAB file also
    holds the frequency response [outputs, inputs, frequencies] from 1/10 000 of the
    sampling rate up to half of it.

    Raises ValueError for a ``folder`` in use, and if neither ``about`` nor the parts of
    the system name a sampling rate.
    """
    system, start = resolve(system), jax.tree.map(jnp.asarray, interface)
    dt = None if about.rate_Hz is None else 1.0 / about.rate_Hz
    model = linearise(system, start.input, system.init(start.start), dt)
    output = system.step(system.init(start.start), start.input)[1]
    inputs, outputs = (
        [slot.name for slot in slots(tree, word)]
        for tree, word in ((start.input, "input"), (output, "output"))
    )
    rate = 1.0 / model.dt
    frequency = np.geomspace(1e-4 * rate, 0.5 * rate, LINES)
    response = np.asarray(model.frequency_response(frequency))
    folder = fresh_folder(folder)
    if to == "octave":
        path = folder / f"{name}.m"
        write_text(path, _function(model, inputs, outputs, name, about))
        return [path]
    path = folder / f"{name}.mat"
    origin = "\n".join(about.origin(SUBJECT))
    write_bytes(path, _mat(model, inputs, outputs, frequency, response, origin))
    return [path]


def to_control(model: StateSpace) -> Any:
    """Return ``model`` as a discrete-time StateSpace of python-control.

    Raises ImportError without python-control, which the extra ``control`` installs.
    """
    import control

    matrices = (np.asarray(m) for m in (model.A, model.B, model.C, model.D))
    return control.ss(*matrices, model.dt)


def from_control(system: Any) -> StateSpace:
    """Return a discrete-time linear ``system`` of python-control as a StateSpace.

    Raises ValueError for a system in continuous time or without a sampling time.
    """
    import control

    model: Any = control.ss(system)
    if not isinstance(model.dt, float) or model.dt <= 0.0:
        raise ValueError(
            f"the sampling time is {model.dt}; a discrete-time system with one is "
            "needed (control.sample_system)"
        )
    return StateSpace(model.A, model.B, model.C, model.D, model.dt)


def _mat(
    model: StateSpace,
    inputs: list[str],
    outputs: list[str],
    frequency: np.ndarray,
    response: np.ndarray,
    origin: str,
) -> bytes:
    """Return the bytes of a MATLAB file with model, response and ``origin``."""
    from scipy.io import savemat

    buffer = io.BytesIO()
    content = {
        "origin": origin,
        **{key: np.asarray(getattr(model, key)) for key in "ABCD"},
        "Ts": model.dt,
        "inputs": np.array(inputs, dtype=object),
        "outputs": np.array(outputs, dtype=object),
        "frequency_Hz": frequency,
        "response": response.transpose(1, 2, 0),  # axes as in freqresp of MATLAB
    }
    savemat(buffer, content)
    return buffer.getvalue()


def _function(
    model: StateSpace,
    inputs: list[str],
    outputs: list[str],
    name: str,
    about: About,
) -> str:
    """Return the text of a function for MATLAB and Octave that returns the model."""
    head = about.origin(f"{name.upper()}  {SUBJECT}")
    alarms = len(about.unsafe)
    lines = [
        *(f"% {each}" for each in head[:alarms]),
        f"function sys = {name}()",
        *(f"% {each}" for each in head[alarms:]),
        *(f"{key} = [{_rows(np.asarray(getattr(model, key)))}];" for key in "ABCD"),
        f"sys = ss(A, B, C, D, {model.dt!r});",
        f"sys.InputName = {_cells(inputs)};",
        f"sys.OutputName = {_cells(outputs)};",
        "end",
        "",
    ]
    return "\n".join(lines)


def _rows(matrix: np.ndarray) -> str:
    if not matrix.size:
        return ""
    return "; ".join(" ".join(repr(float(x)) for x in row) for row in matrix)


def _cells(names: list[str]) -> str:
    return "{" + ", ".join(f"'{name}'" for name in names) + "}"
