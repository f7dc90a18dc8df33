"""Building of a case: read the files of a study, fit its plant, build its loop."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..catalog import CONTROLLERS, PLANTS
from ..control.design_model import NoInverseError
from ..core.about import About
from ..core.arrays import as_array
from ..core.feedback import Feedback, Observation
from ..core.paths import get, replace, static_fields
from ..core.progress import Progress, Silent
from ..core.system import System, accepts
from ..identification import Fit
from ..identification.residual_record import ResidualRecord, load_residual
from ..identification.response_model import ResponseModel
from .case import Case
from .designs import design_of
from .ensemble import Stage, ensemble_of
from .fitted_plant import fitted_plant, on_axes, plant_of_response
from .make_hardware import driven, make_actuator, make_amplifier, make_sensor, per_axis
from .measured_noise import MeasuredNoise, read_noise
from .origin import check_origin
from .parameters import check_value, search_space
from .references import reference_signals
from .schema import Study
from .sources import about_file, source_error, system_of
from .study_file import contents_of, load
from .trajectories import read_trajectories


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
