"""Empirical transfer matrix of periodic records, and its noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...core.rollout import simulate
from ...core.system import System
from ..records.record import Record

EXCITED = 1e-4
"""Least input power of an excited line, as a share of the strongest line."""

INDEPENDENT = 1e-6
"""Ratio of the smallest to the largest eigenvalue of the input power matrix of a line
below which the inputs count as dependent."""


CONFIDENCE = 1.96
"""Half-width of the 95 % interval of a normal error, in standard deviations."""


@dataclass(frozen=True)
class EmpiricalResponse:
    """A measured transfer matrix, line by line.

    ``frequency`` [lines] in Hz; ``response`` [lines, p, m], outputs over inputs;
    ``variance`` [lines, p, m] of its entries due to noise; ``power`` [lines, m, m], the
    weighted sum of ``U U^H`` over the records; ``dt`` in s. An error E of the response
    causes the mean-square output error ``2 sum tr(E power E^H)``.
    """

    frequency: np.ndarray
    response: np.ndarray
    variance: np.ndarray
    power: np.ndarray
    dt: float

    def band(self) -> np.ndarray:
        """Return half the 95 % band [lines, p, m] of the magnitude of ``response``."""
        return CONFIDENCE * np.sqrt(0.5 * self.variance)

    def ahead(self) -> "EmpiricalResponse":
        """Return the response from the inputs to the outputs one sample later."""
        turn = np.exp(2j * np.pi * self.frequency * self.dt)
        return replace(self, response=self.response * turn[:, None, None])


def empirical_response(
    records: Sequence[Record], weights: Sequence[float] | None = None
) -> EmpiricalResponse:
    """Return the least-squares transfer matrix of periodic ``records``, per line.

    Each record holds two or more periods in steady state. The estimate uses their mean;
    their spread gives the noise. With as many records as inputs the matrix is
    ``G = Y U^-1``, of least variance for orthogonal inputs. With more records it is the
    least-squares solution with ``weights`` (1 by default). Lines that no input excites
    are left out. Raises ValueError for records without a period, with fewer than two
    periods, of different period, sample time or channels, for fewer records than
    inputs, or for dependent inputs.
    """
    weights = [1.0] * len(records) if weights is None else weights
    _check_alike(records, weights)
    inputs, outputs, noise = (
        np.stack(parts)
        for parts in zip(*(_spectra(record) for record in records), strict=True)
    )
    weight = np.asarray(weights, float)[:, None, None, None]
    power = np.sum(weight * _outer(inputs, inputs), axis=0)
    strength = np.real(np.trace(power, axis1=1, axis2=2))
    strength[0] = 0.0  # the mean is the operating point, not a response
    lines = np.flatnonzero(strength > EXCITED * strength.max())
    power, inputs, outputs, noise = (
        power[lines],
        inputs[:, lines],
        outputs[:, lines],
        noise[:, lines],
    )
    frequency = lines / (_period(records[0]) * records[0].dt)
    _check_independent(power, frequency)
    inverse = np.linalg.inv(power)
    response = np.sum(weight * _outer(outputs, inputs), axis=0) @ inverse
    # Row i of the response has the covariance P^-1 (sum w^2 s_i^2 U U^H) P^-1, with
    # P the power.
    spread = np.einsum("rli,rlab->liab", noise, weight**2 * _outer(inputs, inputs))
    covariance = inverse[:, None] @ spread @ inverse[:, None]
    variance = np.real(np.diagonal(covariance, axis1=2, axis2=3))
    return EmpiricalResponse(frequency, response, variance, power, records[0].dt)


def _outer(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return left[..., :, None] * right[..., None, :].conj()


def _periods(columns: np.ndarray, period: int) -> np.ndarray:
    """Return the whole periods at the end of a record, [periods, period, channels]."""
    whole = len(columns) // period
    return columns[len(columns) - whole * period :].reshape(whole, period, -1)


def period_spectra(columns: np.ndarray, period: int) -> np.ndarray:
    """Return the spectra [periods, lines, channels] of the whole periods at the end.

    A sinusoid of amplitude a has the modulus a / 2 in its line.
    """
    return np.fft.rfft(_periods(columns, period), axis=1) / period


def _spectra(record: Record) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean spectra [lines, channels] and the variance of the output means."""
    period = _period(record)
    inputs, outputs = (
        period_spectra(columns, period) for columns in (record.inputs, record.outputs)
    )
    noise = np.var(outputs, axis=0, ddof=1) / len(outputs)
    return inputs.mean(axis=0), outputs.mean(axis=0), noise


def _period(record: Record) -> int:
    if record.period is None:
        raise ValueError(f"{record.source}: the record needs a period, in samples")
    return record.period


def _check_alike(records: Sequence[Record], weights: Sequence[float]) -> None:
    if not records:
        raise ValueError("there are no records")
    if len(weights) != len(records) or not np.all(np.asarray(weights) > 0.0):
        raise ValueError(
            f"weights are {list(weights)}; they must be {len(records)} positive numbers"
        )
    kinds = set()
    for record in records:
        period = _period(record)
        if record.samples < 2 * period:
            raise ValueError(
                f"{record.source}: {record.samples} samples hold less than two periods "
                f"of {period}; the noise is the spread between them"
            )
        channels = record.inputs.shape[1], record.outputs.shape[1]
        kinds.add((period, record.dt, *channels))
    if len(kinds) > 1:
        raise ValueError(
            "records differ in (period, sample time, inputs, outputs): "
            f"{sorted(kinds)}; they must be the same"
        )
    channels = records[0].inputs.shape[1]
    if len(records) < channels:
        raise ValueError(
            f"{len(records)} records for {channels} inputs; there must be one for each"
        )


def _check_independent(power: np.ndarray, frequency: np.ndarray) -> None:
    eigenvalues = np.linalg.eigvalsh(power)
    poor = np.flatnonzero(eigenvalues[:, 0] < INDEPENDENT * eigenvalues[:, -1])
    if poor.size:
        raise ValueError(
            f"the inputs are not independent at {frequency[poor[0]]:g} Hz "
            f"({poor.size} lines in all): the response to each cannot be separated"
        )


def periodic_errors(
    model: System, records: Sequence[Record]
) -> Float[np.ndarray, "records periods p"]:
    """Return the rms simulation error of each record, period and output, in its unit.

    The model is driven by the inputs alone. It starts at rest one period before the
    record, so that it has settled when the record begins.
    """
    run = eqx.filter_jit(_outputs)
    found = []
    for record in records:
        period = _period(record)
        inputs = np.concatenate([record.inputs[:period], record.inputs])
        simulated = np.asarray(run(model, jnp.asarray(inputs)))[period:]
        error = _periods(simulated - record.outputs, period)
        found.append(np.sqrt(np.mean(error**2, axis=1)))
    return np.stack(found)


def _outputs(model: System, inputs: Float[Array, "n m"]) -> Float[Array, "n p"]:
    return simulate(model, inputs)[1]
