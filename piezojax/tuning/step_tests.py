"""Step tests of the loops of a study, in the form of its result."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float
from pydantic import BaseModel

from ..analysis.step_response import StepFigures


class StepResult(BaseModel):
    """Figures of one step of a loop of one axis, without noise.

    ``before_um`` and ``after_um`` are the references; the figures are those of
    ``StepFigures``, in s and as shares of the height. A time is None if it exceeds the
    length of the run. All figures are None if the run diverges.
    """

    before_um: float
    after_um: float
    rise_time_s: float | None
    settling_time_s: float | None
    settling_time_fine_s: float | None
    settling_time_noise_s: float | None
    overshoot: float | None
    steady_state_error: float | None

    @classmethod
    def of(cls, run: "StepRun", figures: StepFigures) -> "StepResult":
        """Return the result of ``run``, whose figures are ``figures``."""
        finite = bool(np.all(np.isfinite(run.displacement)))
        length = float(run.time[-1])

        def known(value: Array, most: float = np.inf) -> float | None:
            return float(value) if finite and value <= most else None

        return cls(
            before_um=run.ends[0],
            after_um=run.ends[1],
            rise_time_s=known(figures.rise_time, length),
            settling_time_s=known(figures.settling_time, length),
            settling_time_fine_s=known(figures.settling_time_fine, length),
            settling_time_noise_s=known(figures.settling_time_noise, length),
            overshoot=known(figures.overshoot),
            steady_state_error=known(figures.steady_state_error),
        )


class StepRun(NamedTuple):
    """Run of a loop with ``step_reference``.

    ``ends`` are the references (um) before and after the step, ``time`` is measured
    from the step (s), ``displacement`` is in um.
    """

    ends: tuple[float, float]
    time: Float[np.ndarray, " samples"]
    displacement: Float[np.ndarray, " samples"]
