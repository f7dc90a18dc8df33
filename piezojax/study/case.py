"""Case of a study: read its files, fit its plant, build its loop and search space."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from ..analysis.stability.closed_poles import poles_of, slowest_oscillation
from ..analysis.stability.small_motion import duration_of
from ..catalog import CONTROLLERS, PLANTS
from ..control.design_model import NoInverseError
from ..core.about import About
from ..core.arrays import as_array, as_signal
from ..core.feedback import Feedback, Observation
from ..core.paths import declared, get, replace, static_fields
from ..core.progress import Progress, Silent
from ..core.space import Space
from ..core.system import System, accepts, resolve, rest_output
from ..dynamics.linearise import linearise
from ..identification import Fit
from ..identification.residual_record import ResidualRecord, load_residual
from ..identification.response_model import ResponseModel
from ..signals.missing_hysteresis import TYPICAL_WIDTH
from .designs import design_of
from .ensemble import Ensemble, Stage, ensemble_of
from .fitted_plant import fitted_plant, on_axes, plant_of_response
from .make_hardware import driven, make_actuator, make_amplifier, make_sensor, per_axis
from .measured_noise import MeasuredNoise, read_noise
from .origin import check_origin
from .parameters import check_value, search_space
from .references import reference_signals
from .schema import Study
from .sources import about_file, source_error, system_of
from .study_file import contents_of, load, sha256_of
from .trajectories import read_trajectories

SEARCHED, MOST_SEARCHED = 4.0, 2**15
"""Time constants of the plant's slowest oscillation in the impulse responses of a
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


def build(
    study: Study,
    path: str | Path,
    seed: int | None = None,
    progress: Progress | None = None,
) -> Case:
    """Build the Case of ``study``; ``seed`` replaces the seed of the study.

    The files that the study names lie beside ``path``. ``progress`` reports the fit of
    a plant. Raises ValueError: one line with the key, the value and the allowed values.
    """
    path = Path(path)
    if seed is not None:
        study = study.model_copy(update={"seed": seed})
    contents = contents_of(study, path.parent)  # before a file can change
    trajectories = read_trajectories(study, path.parent)
    study, measured = with_measured_noise(study, path.parent)
    plant, about, fit, response, notes_of_plant = _plant(
        study, path.parent, progress or Silent()
    )
    zero = per_axis(study, lambda axis: as_array(0.0))
    _check_role(plant, zero, "plant", "a voltage to a displacement")
    amplifier = make_amplifier(study)
    plant = driven(amplifier, plant)
    design_notes: list[str] = []

    def controller_of(table: dict[str, Any], where: str) -> System:
        def design(table: dict[str, Any]) -> System:
            return _designed(study, table, plant, fit, design_notes.append)

        folder, rate = path.parent, study.rate
        found = system_of(table, where, folder, CONTROLLERS, rate, design)
        check_origin(about_file(table, folder), study, f"{where}.file")
        observation = Observation(zero, zero, zero, zero)
        _check_role(found, observation, where, "an Observation to a command")
        return found

    controller = controller_of(study.controller, "controller")
    loop = Feedback(controller, plant, make_actuator(study), make_sensor(study))
    loop, space, notes = search_space(study, loop)
    _check_rates(study, loop, "the controller or plant")
    stage = Stage(loop.plant, loop.sensor)
    ensemble = ensemble_of(study, stage, path.parent, amplifier)
    plants = {
        name: driven(amplifier, plant)
        for name, plant in _swept_plants(study, zero).items()
    }
    return Case(
        study,
        path.stem,
        loop,
        space,
        reference_signals(study, trajectories),
        fit,
        ensemble,
        plants,
        (
            *(trajectory.note for trajectory in trajectories.values()),
            *(noise.note for noise in measured.values()),
            *notes_of_plant,
            *design_notes,
            *notes,
            *(ensemble.notes if ensemble else ()),
        ),
        about,
        amplifier,
        {
            name: _with_gains(
                controller_of(table.controller, f"beside.{name}.controller"),
                table.gains,
                study,
                f"beside.{name}",
            )
            for name, table in study.beside.items()
        },
        **measured,
        saved_residual=_saved_residual(study, path.parent, about),
        response=response,
        folder=path.parent,
        contents=contents,
    )


def read(path: str | Path, seed: int | None = None) -> Case:
    """Load the study file ``path`` and build its Case.

    Raises ValueError as ``build`` does.
    """
    return build(load(path), path, seed)


def with_measured_noise(
    study: Study, folder: Path
) -> tuple[Study, dict[str, MeasuredNoise]]:
    """Return ``study`` with the rms noise of its sensor, and the measured noise.

    The keys of the measured noise are fields of a Case.
    """
    units = study.axes.units if study.axes else ("um",)
    volts = ("V",) * study.axis_count
    tables = {
        "sensor_noise": (study.sensor.measured_noise, "sensor.measured_noise", units),
        "output_disturbance": (study.disturbance.output, "disturbance.output", units),
        "input_disturbance": (study.disturbance.input, "disturbance.input", volts),
    }
    found = {
        name: read_noise(
            table, study, folder, where, each, sensor=name == "sensor_noise"
        )
        for name, (table, where, each) in tables.items()
        if table is not None
    }
    if "sensor_noise" in found:
        rms = tuple(found["sensor_noise"].rms.tolist())
        sensor = study.sensor.model_copy(
            update={"noise_rms": rms if study.axes else rms[0]}
        )
        study = study.model_copy(update={"sensor": sensor})
    return study, found


class _Plant(NamedTuple):
    """Plant of a study with its origin and notes, and its fit if it has one."""

    system: System
    about: About
    fit: Fit | None = None
    response: ResponseModel | None = None
    notes: Sequence[str] = ()


_FITTED = "record", "records", "response"
"""Keys of a plant that is fitted in the study."""


def _plant(study: Study, folder: Path, progress: Progress) -> _Plant:
    """Return the plant of ``study``, whose files lie in ``folder``."""
    table = study.plant
    given = [key for key in _FITTED if key in table]
    if not given:
        plant = system_of(table, "plant", folder, PLANTS, study.rate)
        about = about_file(table, folder)
        check_origin(about, study, "plant.file")
        return _Plant(on_axes(plant, study), about)
    sources = ("catalog", "file", "type")
    if len(given) > 1 or set(table) & set(sources):
        raise source_error(table, "plant", (*sources, "record", "response"))
    if given == ["response"]:
        model = plant_of_response(table, study, folder)
        notes = [f"plant.response: {model.report.found}", *model.report.notes]
        return _Plant(model.system, model.about, None, model, notes)
    fit, about, notes = fitted_plant(table, study, folder, progress)
    return _Plant(on_axes(fit.system, study), about, fit, None, notes)


def _saved_residual(study: Study, folder: Path, about: About) -> ResidualRecord | None:
    """Return the residual beside the file of the plant, if there is one."""
    if "file" not in study.plant:
        return None
    try:
        return load_residual(folder / str(study.plant["file"]), about)
    except ValueError as error:
        raise ValueError(f"plant.file: {error}") from None


def _swept_plants(study: Study, zero: Any) -> dict[str, System]:
    plants = {}
    for name in study.sweep.plants if study.sweep else ():
        where = f"sweep.plants.{name}"
        plant = system_of({"catalog": name}, where, Path(), PLANTS, study.rate)
        _check_role(plant, zero, where, "a voltage to a displacement")
        _check_rates(study, plant, where)
        plants[name] = plant
    return plants


def _with_gains(
    controller: System, gains: Mapping[str, float], study: Study, where: str
) -> System:
    """Return ``controller`` with the values ``gains``, by path.

    Raises ValueError, starting with ``where``, for a wrong rate, path or value.
    """
    _check_rates(study, controller, where)
    for path, value in gains.items():
        try:
            get(controller, path)
        except ValueError as error:
            raise ValueError(f"{where}.gains: {error}") from None
        check_value(controller, path, value, f"{where}.gains.{path}")
    return replace(controller, gains)


def _designed(
    study: Study,
    table: dict[str, Any],
    plant: System,
    fit: Fit | None,
    note: Callable[[str], None],
) -> System:
    """Return the controller of the design in ``table``, with its settings.

    A fitted hysteresis without an inverse between the limits of the actuator may have
    one over the range of its record, beyond which it extrapolates. The voltage then
    stays within the record, and ``note`` is called with a sentence on this.
    """
    design = design_of(table)
    if study.axes is not None:
        raise ValueError(
            f"designs are for one axis; the study has {study.axis_count}: give the "
            "controller as catalog, file or type"
        )
    (lower,), (upper,) = (
        study.by_axis(limit) for limit in (study.actuator.lower, study.actuator.upper)
    )
    try:
        return design(plant, study.dt, (lower, upper))
    except NoInverseError as error:
        if fit is None:
            raise
        recorded = fit.record.input
        inner = max(lower, float(recorded.min())), min(upper, float(recorded.max()))
        try:
            controller = design(plant, study.dt, inner)
        except ValueError:
            raise NoInverseError(
                f"{error}. The model has none over its record either, "
                f"{inner[0]:.4g} to {inner[1]:.4g} V: record several cycles over the "
                "whole range, or name another plant.model"
            ) from None
        note(
            f"controller.design: {error}. The model has an inverse over its record, "
            f"{inner[0]:.4g} to {inner[1]:.4g} V: the voltage stays between these"
        )
        return controller


def _check_role(system: System, example: Any, where: str, role: str) -> None:
    """Raise ValueError unless ``system`` accepts ``example`` as its input."""
    if not accepts(system, example):
        raise ValueError(f"{where} is a {type(system).__name__}; it must map {role}")


def _check_rates(study: Study, system: System, name: str) -> None:
    for dt in static_fields(system, "dt"):
        if not np.isclose(dt, study.dt, rtol=1e-9, atol=0.0):
            raise ValueError(
                f"rate is {study.rate:g} Hz, but {name} was made for {1.0 / dt:g} Hz"
            )
