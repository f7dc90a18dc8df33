"""Fit of state-space models to a measured transfer matrix."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy import linalg, special

from ...dynamics import StateSpace, reflected
from ...solve.gauss_newton import SEQUENTIAL, Descent, GaussNewton, Trials
from ...solve.local_model import LocalModel
from ...solve.multi_start import Patience, descend
from .frequency import EmpiricalResponse

STEPS = 20
"""Largest number of steps of the descent."""

ENOUGH = Patience(1, share=1e-4)
"""Relative decrease of the cost below which the descent ends."""


@dataclass(frozen=True)
class ResponseFit:
    """A model fitted to a transfer matrix.

    ``singular_values``: those of the data, largest first; the order chosen should lie
    at a gap. ``costs``: the mean-square output error per step of the descent, the start
    first. ``moved``: number of poles of the start that were moved into the unit circle.
    """

    model: StateSpace
    singular_values: np.ndarray
    costs: np.ndarray
    moved: int


def fit_response(
    measured: EmpiricalResponse, order: int, *, rows: int = 30, steps: int = STEPS
) -> ResponseFit:
    """Fit a stable model with ``order`` states to ``measured``.

    The cost is the mean square of the output error under the inputs of the records, as
    in a validation by simulation; it is not weighted by the noise. The fit starts at
    the subspace estimate of McKelvey, Akcay and Ljung (IEEE Trans. Automatic Control
    41, 1996, algorithm 1) with ``rows`` block rows, stabilised if necessary, and is
    ``refined`` from there. Raises ValueError unless 1 <= order < rows * p, or for fewer
    lines than the block rows need.
    """
    lines, outputs, inputs = measured.response.shape
    if not 1 <= order < rows * outputs:
        raise ValueError(
            f"order is {order}; with {rows} block rows of {outputs} outputs it must "
            f"lie in 1..{rows * outputs - 1}"
        )
    if 2 * lines * inputs < rows * (inputs + outputs):
        raise ValueError(
            f"{lines} lines are too few for {rows} block rows; take "
            f"{2 * lines * inputs // (inputs + outputs)} or fewer"
        )
    basis, singular_values = _observability(_data(measured), rows)
    start, moved = _realised(basis[:, :order], measured)
    model, costs = refined(start, measured, steps)
    return ResponseFit(model, singular_values, costs, moved)


def refined(
    model: StateSpace, measured: EmpiricalResponse, steps: int = STEPS
) -> tuple[StateSpace, Float[np.ndarray, " steps"]]:
    """Return ``model`` adjusted to fit ``measured``, and the cost of each step.

    The descent is Levenberg-Marquardt over modes whose poles are
    ``sigmoid(a) exp(j b)``, stable for all a and b. It starts from the modes of
    ``model``, which must have as many poles as states. The matrices are blocks of one
    mode each, in the order and scale of the start: models refined from one start can be
    compared block by block.
    """
    modes, costs = _descend(_modes_of(model), _data(measured), steps)
    return _model_of(modes, measured.dt), np.array(costs)


class _Data(NamedTuple):
    """Measured response, weighted by ``root``, the Cholesky factor of twice the power.

    The squares of ``target``, response @ root, sum to the outputs' mean square.
    """

    z: Complex[Array, " lines"]
    root: Complex[Array, "lines m m"]
    target: Complex[Array, "lines p m"]


def _data(measured: EmpiricalResponse) -> _Data:
    z = np.exp(2j * np.pi * measured.dt * measured.frequency)
    root = np.linalg.cholesky(2.0 * measured.power)
    return _Data(*map(jnp.asarray, (z, root, measured.response @ root)))


def _observability(data: _Data, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a basis of the extended observability matrix, and singular values."""

    def stack(columns):
        powers = np.asarray(data.z) ** np.arange(rows)[:, None]
        blocks = np.einsum("rl,lij->rilj", powers, columns)
        flat = blocks.reshape(rows * columns.shape[1], -1)
        return np.hstack([np.real(flat), np.imag(flat)])

    inputs = stack(np.asarray(data.root))
    both = np.vstack([inputs, stack(np.asarray(data.target))])
    triangle = np.asarray(np.linalg.qr(both.T, mode="r"))
    known = len(inputs)
    basis, values, _ = np.linalg.svd(triangle[known : len(both), known:].T)
    return basis, values


def _realised(basis: np.ndarray, measured: EmpiricalResponse) -> tuple[StateSpace, int]:
    """Return the model: A and C by shift invariance, B and D by least squares."""
    n, p = basis.shape[1], measured.response.shape[1]
    A, moved = reflected(np.linalg.lstsq(basis[:-p], basis[p:])[0])
    C, eye = basis[:p], np.eye(p)
    states = StateSpace(A, np.eye(n), C, np.zeros((p, n)), measured.dt)
    resolvent = np.asarray(states.frequency_response(measured.frequency))
    known = np.dstack([resolvent, np.broadcast_to(eye, (len(resolvent), p, p))])
    strength = np.sqrt(np.real(np.trace(measured.power, axis1=1, axis2=2)))

    def flat(blocks):
        rows = (strength[:, None, None] * blocks).reshape(-1, blocks.shape[2])
        return np.vstack([np.real(rows), np.imag(rows)])

    solution = np.linalg.lstsq(flat(known), flat(measured.response))[0]
    return StateSpace(A, solution[:n], C, solution[n:], measured.dt), moved


class _Modes(NamedTuple):
    """Poles sigmoid(size) exp(j angle) with residues ``left right^T``.

    ``pairs`` [k, 2 + 2 p + 2 m]: size, angle, then left and right, real before
    imaginary part, of each complex pair; ``singles`` [r, 1 + p + m]: size, left and
    right of each real pole; ``signs`` [r] of the real poles; ``feedthrough`` [p, m].
    """

    pairs: Float[Array, "k parts"]
    singles: Float[Array, "r parts"]
    signs: Float[Array, " r"]
    feedthrough: Float[Array, "p m"]


def _modes_of(model: StateSpace) -> _Modes:
    poles, vectors = map(np.asarray, np.linalg.eig(np.asarray(model.A)))
    left = np.asarray(model.C) @ vectors
    right = np.linalg.solve(vectors, np.asarray(model.B) + 0j)
    # Give both sides of a residue equal size, so that the descent is well scaled.
    scale = np.sqrt(np.linalg.norm(right, axis=1) / np.linalg.norm(left, axis=0))
    left, right = (left * scale).T, right / scale[:, None]
    size = special.logit(np.clip(np.abs(poles), 1e-9, 1.0 - 1e-9))[:, None]
    sides = [part(side) for side in (left, right) for part in (np.real, np.imag)]
    pairs = np.hstack([size, np.angle(poles)[:, None], *sides])
    singles = np.hstack([size, *sides[::2]])
    pair, single = np.imag(poles) > 0.0, np.imag(poles) == 0.0
    return _Modes(
        jnp.asarray(pairs[pair]),
        jnp.asarray(singles[single]),
        jnp.where(np.real(poles[single]) < 0.0, -1.0, 1.0),
        model.D,
    )


def _pair(parts: Array, outputs: int) -> tuple[Array, Array, Array]:
    """Return pole, left [p] and right [m] of a complex pair."""
    pole = jax.nn.sigmoid(parts[0]) * jnp.exp(1j * parts[1])
    left, right = parts[2 : 2 + 2 * outputs], parts[2 + 2 * outputs :]
    return pole, _complex(left), _complex(right)


def _complex(parts: Array) -> Array:
    real, imaginary = jnp.split(parts, 2)
    return real + 1j * imaginary


def _single(parts: Array, sign: Array, outputs: int) -> tuple[Array, Array, Array]:
    """Return pole, left [p] and right [m] of a real pole."""
    return (
        sign * jax.nn.sigmoid(parts[0]),
        parts[1 : 1 + outputs],
        parts[1 + outputs :],
    )


def _weighted(pole: Array, left: Array, right: Array, data: _Data) -> Array:
    """Return the contribution of one pole to the response, times ``root``."""
    right = right @ data.root
    return left[:, None] * (right / (data.z - pole)[:, None])[:, None, :]


def _pair_response(parts: Array, data: _Data) -> Array:
    pole, left, right = _pair(parts, data.target.shape[1])
    return _weighted(pole, left, right, data) + _weighted(
        pole.conj(), left.conj(), right.conj(), data
    )


def _single_response(parts: Array, sign: Array, data: _Data) -> Array:
    return _weighted(*_single(parts, sign, data.target.shape[1]), data)


def _residuals(modes: _Modes, data: _Data) -> Complex[Array, "lines p m"]:
    pairs = jax.vmap(lambda parts: _pair_response(parts, data))(modes.pairs)
    singles = jax.vmap(lambda parts, sign: _single_response(parts, sign, data))(
        modes.singles, modes.signs
    )
    direct = modes.feedthrough @ data.root
    return pairs.sum(axis=0) + singles.sum(axis=0) + direct - data.target


@jax.jit
def _cost(modes: _Modes, data: _Data) -> Array:
    return jnp.sum(jnp.abs(_residuals(modes, data)) ** 2)


@jax.jit
def _normal_equations(modes: _Modes, data: _Data) -> tuple[Array, Array]:
    """Return gradient and Gauss-Newton matrix of half the cost; order as ``_moved``."""
    outputs, inputs = modes.feedthrough.shape

    def slopes(response):
        return lambda parts, *rest: jnp.moveaxis(
            jax.jacfwd(response)(parts, *rest), -1, 0
        )

    # A parameter moves its own mode alone: the Jacobian is built mode by mode.
    pair = slopes(lambda parts: _pair_response(parts, data))
    single = slopes(lambda parts, sign: _single_response(parts, sign, data))
    units = jnp.eye(outputs * inputs).reshape(-1, 1, outputs, inputs)
    jacobian = jnp.concatenate(
        [
            _flat(jax.vmap(pair)(modes.pairs)),
            _flat(jax.vmap(single)(modes.singles, modes.signs)),
            _flat(units @ data.root),
        ]
    )
    residuals = _flat(_residuals(modes, data)[None])[0]
    return jacobian @ residuals, jacobian @ jacobian.T


def _flat(slopes: Array) -> Array:
    """Return slopes [..., lines, p, m] as real rows, one for each unknown."""
    rows = slopes.reshape(-1, int(np.prod(slopes.shape[-3:])))
    return jnp.hstack([rows.real, rows.imag])


def _moved(modes: _Modes, change: np.ndarray) -> _Modes:
    sizes = np.cumsum([modes.pairs.size, modes.singles.size])
    pairs, singles, feedthrough = np.split(change, sizes)
    return modes._replace(
        pairs=modes.pairs + pairs.reshape(modes.pairs.shape),
        singles=modes.singles + singles.reshape(modes.singles.shape),
        feedthrough=modes.feedthrough + feedthrough.reshape(modes.feedthrough.shape),
    )


def _descend(modes: _Modes, data: _Data, steps: int) -> tuple[_Modes, list[float]]:
    """Fit the modes by damped Gauss-Newton steps on the normal equations."""

    def linearise(changes: np.ndarray) -> list[LocalModel]:
        equations = _normal_equations(_moved(modes, changes[0]), data)
        gradient, curvature = map(np.asarray, equations)
        # Unit diagonal, except for unknowns of almost no effect, which then do not
        # move.
        size = np.sqrt(np.diag(curvature))
        size = np.maximum(size, 1e-6 * size.max())
        return [LocalModel(changes[0], gradient, curvature, size**2)]

    def evaluate(changes: np.ndarray) -> list[Trials]:
        costs = [float(_cost(_moved(modes, change), data)) for change in changes[0]]
        return [Trials(0.5 * np.array(costs))]

    start = np.zeros(sum(part.size for part in modes) - modes.signs.size)
    half = 0.5 * float(_cost(modes, data))
    descent = Descent(start, SEQUENTIAL, patience=ENOUGH, loss=half, losses=[half])
    descents = GaussNewton([descent], evaluate, linearise)
    descend(descents, steps, lambda standing: None)
    losses = descent.losses
    # A last step without a decrease does not count.
    if len(losses) > 1 and losses[-1] == losses[-2]:
        losses = losses[:-1]
    return _moved(modes, descent.point), [2.0 * loss for loss in losses]


def _model_of(modes: _Modes, dt: float) -> StateSpace:
    """Return the block-diagonal model of the modes."""
    outputs = len(modes.feedthrough)
    A, B, C = [], [], []
    for parts in modes.pairs:
        pole, left, right = _pair(parts, outputs)
        A.append(np.array([[pole.real, -pole.imag], [pole.imag, pole.real]]))
        B += [right.real, right.imag]
        C += [2.0 * left.real, -2.0 * left.imag]
    for parts, sign in zip(modes.singles, modes.signs, strict=True):
        pole, left, right = _single(parts, sign, outputs)
        A.append(np.array([[pole]]))
        B.append(right)
        C.append(left)
    return StateSpace(
        linalg.block_diag(*A), np.array(B), np.array(C).T, modes.feedthrough, dt
    )
