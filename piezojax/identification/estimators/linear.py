"""Linear multivariable models, fitted by subspace or by frequency response."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ...core.arrays import as_array
from ...core.progress import Progress
from ...core.rollout import simulate
from ...core.system import Affine, System, series
from ...dynamics import StateSpace, stacked
from ..records.record import Record
from ..records.resample import whole_periods
from .estimate import Estimate, FittedParameter, LinearDetail, Options
from .frequency import EmpiricalResponse, empirical_response
from .response_fit import fit_response
from .subspace import identify_channel


class Centre(NamedTuple):
    """Means of the inputs [m] and outputs [p], removed before a linear fit."""

    input: np.ndarray
    output: np.ndarray

    @classmethod
    def of(cls, record: Record, train: slice) -> "Centre":
        return cls(
            record.inputs[train].mean(axis=0), record.outputs[train].mean(axis=0)
        )

    def removed(self, record: Record) -> Record:
        return replace(
            record,
            inputs=record.inputs - self.input,
            outputs=record.outputs - self.output,
        )


def by_subspace(
    model: str,
    records: Sequence[Record],
    train: slice,
    options: Options,
    progress: Progress,
) -> Estimate:
    """Fit a state-space model to records that each drive one input, in their order.

    Each channel has its MAP estimate of the Hankel-Toeplitz model; the models of the
    channels are stacked (chapter 6).
    """
    del model
    progress.stage(f"regression with {options.window} past and future samples")
    centres = [Centre.of(record, train) for record in records]
    fits = [
        identify_channel(
            centre.removed(record).until(train.stop), options.window, options.order
        )
        for record, centre in zip(records, centres, strict=True)
    ]
    stage = stacked([fit.model for fit in fits])
    runs = []
    for channel, record in enumerate(records):
        inputs = np.zeros((record.samples, len(records)))
        inputs[:, channel] = record.input - centres[channel].input
        run = np.asarray(steady_run(stage, as_array(inputs), 0))
        runs.append(run + centres[channel].output)
    warnings = [
        f"{record.source}: {note}"
        for record, fit in zip(records, fits, strict=True)
        for note in fit.notes
    ]
    detail = LinearDetail(
        stage,
        options.order,
        {
            record.source: fit.singular_values
            for record, fit in zip(records, fits, strict=True)
        },
    )
    return _linear(detail, tuple(runs), warnings, centres[0])


def by_frequency_response(
    model: str,
    records: Sequence[Record],
    train: slice,
    options: Options,
    progress: Progress,
) -> Estimate:
    """Fit a state-space model to the transfer matrix of periodic records.

    Raises ValueError as ``empirical_response`` and ``fit_response`` do.
    """
    del model
    progress.stage("measuring the transfer matrix")
    centres = [Centre.of(record, train) for record in records]
    measured = empirical_response([whole_periods(record, train) for record in records])
    progress.stage(f"fitting {options.order} states to it")
    fit = fit_response(measured, options.order)
    stage = _without_feedthrough(fit.model, measured, fit.costs[-1])
    warnings = (
        [f"{fit.moved} poles of the start lay outside the unit circle; reflected"]
        if fit.moved
        else []
    )
    runs = tuple(
        np.asarray(
            steady_run(
                stage, as_array(record.inputs - centre.input), record.period or 0
            )
        )
        + centre.output
        for record, centre in zip(records, centres, strict=True)
    )
    detail = LinearDetail(stage, options.order, {"": fit.singular_values}, measured)
    return _linear(detail, runs, warnings, centres[0])


def _without_feedthrough(
    model: StateSpace, measured: EmpiricalResponse, left: float
) -> StateSpace:
    """Set D to zero unless its mean-square output exceeds ``left``, the fit's error.

    In a loop, a held input acts on the sampled output one sample later.
    """
    D = np.asarray(model.D)
    added = 2.0 * np.real(np.einsum("pa,lab,pb->", D, measured.power, D))
    if added > left:
        return model
    return replace(model, D=np.zeros_like(D))


@eqx.filter_jit
def steady_run(
    model: System, inputs: Float[Array, "n m"], settle: int
) -> Float[Array, "n p"]:
    """Return the free run under ``inputs``, from rest or from a settled state.

    The state settles from rest under the first ``settle`` inputs.
    """
    state = model.init(inputs[0])
    if settle:
        state, _ = simulate(model, inputs[:settle], state)
    return simulate(model, inputs, state)[1]


def _linear(
    detail: LinearDetail,
    runs: tuple[np.ndarray, ...],
    warnings: list[str],
    centre: "Centre",
) -> Estimate:
    """Return the estimate as a plant for a loop, in which u(k) moves y(k+1)."""
    stage = detail.model
    if np.any(np.asarray(stage.D)):
        warnings = [
            *warnings,
            "the input reaches the output within its sample; in a loop the model acts "
            "one sample later",
        ]
        plant = stage
    else:
        plant = stage.one_step_ahead()
    poles = np.abs(stage.poles())
    named = {
        "largest pole modulus": FittedParameter(
            value=float(poles.max()), standard_error=None
        )
    }
    if stage.D.shape == (1, 1):
        # The plant of a study has scalar signals, not vectors of length 1.
        gain = float(stage.dc_gain()[0, 0])
        offset = float(centre.output[0] - gain * centre.input[0])
        system: System = series(
            dynamics=plant.as_arma(), calibration=Affine(1.0, offset)
        )
    else:
        system = plant
        warnings = [*warnings, "inputs and outputs are deviations from their means"]
    # Count the parameters invariant under similarity, and the means of the outputs.
    outputs, inputs = stage.D.shape
    count = stage.order * (inputs + outputs) + np.count_nonzero(stage.D) + outputs
    return Estimate(
        system, runs, named, warnings, 2 * stage.order, linear=detail, count=int(count)
    )
