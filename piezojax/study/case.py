"""Case of a study: its loop, signals, search space and drawn plants."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from ..analysis.stability.closed_poles import poles_of, slowest_oscillation
from ..analysis.stability.small_motion import duration_of
from ..core.about import About
from ..core.arrays import as_signal
from ..core.feedback import Feedback
from ..core.paths import declared
from ..core.space import Space
from ..core.system import System, resolve, rest_output
from ..dynamics.linearise import linearise
from ..identification import Fit
from ..identification.residual_record import ResidualRecord
from ..identification.response_model import ResponseModel
from ..signals.missing_hysteresis import TYPICAL_WIDTH
from .ensemble import Ensemble, Stage
from .measured_noise import MeasuredNoise
from .schema import Study
from .study_file import sha256_of

SEARCHED, MOST_SEARCHED = 4.0, 2**15
"""Time constants of the slowest oscillation of the plants in the impulse responses of a
search, after which 2 % of a peak is missing, and the most samples of these responses: a
gradient stores them."""


@dataclass(frozen=True)
class Case:
    """A study with its loop and its search space.

    ``references`` holds those of tuning first, then the unseen ones, in um or in the
    units of the axes. ``fit`` is the fit of the plant to a record, None for other
    plants. ``plants`` maps names to the plants of a sweep, which replace the plant of
    the loop. ``notes`` are sentences about files, the plant, a design whose voltage
    stays within the record, and starts that differ from the controller of the study.
    ``plant_about`` is the origin of a plant from a record or a file, with the bound on
    its error. ``amplifier`` maps the voltage of the actuator to that of the piezo, both
    in V; it is part of the plant, and None if the study has none. ``beside`` maps names
    to the controllers with which the tuned one is compared. ``sensor_noise``,
    ``output_disturbance`` and ``input_disturbance`` are read from files;
    ``study.sensor.noise_rms`` is then the rms value of ``sensor_noise``.
    ``saved_residual`` is the residual of a plant from a file, ``response`` the model of
    a plant that is fitted to a frequency response. The names of files in ``study`` are
    relative to ``folder``; ``contents`` are their SHA-256 when the case was built.
    """

    study: Study
    name: str
    loop: Feedback
    space: Space
    references: Float[np.ndarray, "references samples *axes"]
    fit: Fit | None = None
    ensemble: Ensemble | None = None
    plants: Mapping[str, System] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    plant_about: About = field(default_factory=About)
    amplifier: System | None = None
    beside: Mapping[str, System] = field(default_factory=dict)
    sensor_noise: MeasuredNoise | None = None
    output_disturbance: MeasuredNoise | None = None
    input_disturbance: MeasuredNoise | None = None
    saved_residual: ResidualRecord | None = None
    response: ResponseModel | None = None
    folder: Path = Path()
    contents: tuple[str, ...] = ()

    @property
    def sha256(self) -> str:
        """SHA-256 that identifies the study with its files."""
        return sha256_of(self.study, self.contents)

    @cached_property
    def residual(self) -> ResidualRecord | None:
        """Residual of the plant, from the fit of this study or from its file, or
        None."""
        return self.saved_residual if self.fit is None else ResidualRecord.of(self.fit)

    @property
    def assumed_hysteresis(self) -> float:
        """Relative width of the hysteresis loop that the plant lacks, 0 if none."""
        given = self.study.disturbance.hysteresis
        if given is None:
            return TYPICAL_WIDTH if self.plant_about.small_motions else 0.0
        return given

    @property
    def margin_reference(self) -> float | tuple[float, ...]:
        """Operating point of the margins of a study, um; a tuple on several axes.

        It is the end of the range of all references that is farther from the plant's
        rest point at 0 V: there the branches of a hysteresis differ most.
        """
        return self._ends[0]

    @property
    def nearer_reference(self) -> float | tuple[float, ...]:
        """The other end of the range of all references, as ``margin_reference``."""
        return self._ends[1]

    @cached_property
    def margin_duration(self) -> float:
        """Length of the impulse responses of margins in searches and sweeps, s.

        It follows from the slowest oscillation about 0 V of the plant and of the drawn
        plants whose margins are limited. It must be known before a program uses it.
        """
        dt, rest = self.study.dt, as_signal(np.zeros(np.shape(self.margin_reference)))

        def matrix(plant: System) -> Float[Array, "n n"]:
            return linearise(resolve(plant), rest, dt=dt).A

        def of_stages(stages: Stage) -> Float[Array, "stages n n"]:
            return jax.lax.map(lambda stage: matrix(stage.plant), stages)

        drawn = self.ensemble.stages("margins") if self.ensemble else None
        found = [matrix(self.loop.plant)[None]]
        if drawn is not None:
            found.append(jax.jit(of_stages)(drawn))
        slowest = np.max(slowest_oscillation(poles_of(np.concatenate(found)))).item()
        return duration_of(dt * slowest, dt, SEARCHED, MOST_SEARCHED)

    @cached_property
    def _ends(self) -> tuple[Any, Any]:
        high, low = (f(self.references, axis=(0, 1)) for f in (np.max, np.min))
        with jax.ensure_compile_time_eval():  # a program may need it first
            rest = rest_output(self.loop.plant, as_signal(np.zeros_like(high)))
        rest = np.stack(jax.tree.leaves(rest)).reshape(high.shape)
        below = np.abs(low - rest) > np.abs(high - rest)
        ends = np.where(below, low, high), np.where(below, high, low)
        axes = self.study.axes
        far, near = (tuple(x.tolist()) if axes else float(x) for x in ends)
        return far, near

    def unit(self, path: str) -> str:
        """Return the declared unit of the parameter at ``path`` in the loop.

        The unit is "" if none is declared. On a stage with several axes it is also ""
        for units that contain um or V, because each axis has its own units.
        """
        known = declared(self.loop, path)
        if known is None:
            return ""
        lengths = {"um", "V"} & set(re.findall("[A-Za-z]+", known.unit))
        return "" if self.study.axes and lengths else known.unit
