"""Linear feedback of a controller as second-order sections (biquads)."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ..core.about import About, commented
from ..core.files import fresh_folder, write_text
from ..core.rollout import simulate
from ..core.system import Affine, System, resolve
from ..dynamics.linearise import linearise, split_static
from .driven import Driven, Seen
from .slots import Interface

CONVENTION = (
    "Sections in series, each y = b0 x + b1 x1 + b2 x2 - a1 y1 - a2 y2 with a0 = 1.",
    "a1 and a2 have the signs of textbooks and SciPy: a device that adds a1 y1 and "
    "a2 y2 needs both signs changed.",
    "x is the input and y the output; x1, y1 are one sample old, x2, y2 two samples.",
    "Input: the error, reference minus measurement. Output: the voltage minus the "
    "voltage at rest. Reference feedforward, limits and anti-windup are left out.",
)
"""Equation and sign convention of a section, for the head of the file."""

SAMPLES, SHARE, TOLERANCE = 200, 0.05, 1e-6
"""Linearity test: samples in one period of the sine, its amplitude as a share of half
the reference range, and the largest accepted difference as a share of the largest
output."""


def write_biquads(
    system: System, interface: Interface, folder: Path, name: str, about: About
) -> list[Path]:
    """Write the feedback of a controller to the new ``folder`` as CSV; return the path.

    Each row is a section. The sections hold the controller linearised at rest. Raises
    ValueError for a ``folder`` in use, a plant, several axes, an unknown sampling rate,
    a controller that learns or counts samples, and a nonlinear feedback, which the
    sections do not reproduce.
    """
    if not isinstance(system, Driven) or isinstance(interface.input.measured, tuple):
        raise ValueError("biquads hold the feedback of a controller of one axis")
    kind = type(system.controller).__name__
    controller = resolve(Driven(system.controller, Affine()))
    start = jax.tree.map(jnp.asarray, interface)
    state, rest = controller.init(start.start), start.start
    if jax.tree.leaves(split_static(state)[1]):
        raise ValueError(f"{kind} learns or counts samples; biquads do neither")
    still = Seen(rest.reference, rest.reference, rest.measured)
    dt = None if about.rate_Hz is None else 1.0 / about.rate_Hz
    model = linearise(controller, still, state, dt)
    A, B, C, D = (np.asarray(m) for m in (model.A, model.B, model.C, model.D))
    sections = sections_of(A, -B[:, -1], C[0], -D[0, -1])  # measured comes last
    low, high = about.reference_ranges[0] if about.reference_ranges else (-1.0, 1.0)
    swing = np.sin(2.0 * np.pi * np.arange(SAMPLES) / SAMPLES)
    moved = 0.5 * SHARE * (high - low) * swing
    inputs = jax.tree.map(lambda x: jnp.full(SAMPLES, x), still)
    inputs = inputs._replace(measured=inputs.measured + moved)
    voltage = np.asarray(simulate(controller, inputs, state)[1] - rest.applied)
    difference = np.max(np.abs(voltage - _filtered(sections, -moved)))
    if not difference <= TOLERANCE * np.max(np.abs(voltage)):
        raise ValueError(
            f"the feedback of {kind} is not linear; biquads do not reproduce it"
        )
    about = about.model_copy(update={"rate_Hz": 1.0 / model.dt})
    head = about.origin(f"Feedback of {kind} as {len(sections)} biquads")
    rows = (",".join(repr(float(x)) for x in row) for row in sections)
    table = "\n".join(["b0,b1,b2,a0,a1,a2", *rows, ""])
    path = fresh_folder(folder) / f"{name}_biquads.csv"
    write_text(path, commented([*head, *CONVENTION]) + table)
    return [path]


def sections_of(A: np.ndarray, b: np.ndarray, c: np.ndarray, d: float) -> np.ndarray:
    """Return the second-order sections of ``c (z I - A)^-1 b + d`` in SciPy's layout.

    For n states, ``A`` is [n, n], ``b`` and ``c`` are [n]. The result is [sections, 6]
    with the columns b0, b1, b2, a0, a1, a2. Uncontrollable and unobservable states are
    removed. Each sample of pure delay is a section of its own.
    """
    from scipy.signal import zpk2sos

    for _ in range(2):  # remove uncontrollable states, then unobservable ones
        basis = _krylov(A, b)
        A, b, c = (basis.T @ A @ basis).T, basis.T @ c, basis.T @ b
    poles = np.linalg.eigvals(A)
    poles = np.where(np.abs(poles - 1.0) < 1e-9, 1.0, poles)  # integrators
    impulse, x = [d], b
    for _ in poles:
        impulse, x = [*impulse, c @ x], A @ x
    numerator = np.convolve(np.real(np.poly(poles)), impulse)[: len(impulse)]
    large = np.abs(numerator) > 1e-12 * np.max(np.abs(numerator))
    delay = int(np.argmax(large))
    zeros = np.roots(numerator[delay:])
    sections = zpk2sos(zeros, poles, numerator[delay])
    delays = [[0.0, 1.0, 0.0, 1.0, 0.0, 0.0]] * delay
    return np.vstack([sections, *delays])


def _krylov(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis [n, r] of the r states controllable from ``b``."""
    basis, v = np.zeros((len(b), 0)), b
    while basis.shape[1] < len(b):
        size = np.linalg.norm(v)
        for _ in range(2):
            v = v - basis @ (basis.T @ v)
        if np.linalg.norm(v) <= 1e-10 * size:
            break
        basis = np.column_stack([basis, v / np.linalg.norm(v)])
        v = A @ basis[:, -1]
    return basis


def _filtered(sections: np.ndarray, x: np.ndarray) -> np.ndarray:
    from scipy.signal import sosfilt

    return np.asarray(sosfilt(sections, x))
