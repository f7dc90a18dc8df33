"""Ensembles: random stages around the nominal stage of a study."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import BaseModel
from scipy.special import ndtr

from ..catalog import PLANTS, deviations_of
from ..core.arrays import as_array
from ..core.feedback import Feedback
from ..core.files import read_model
from ..core.paths import declared, get, parameters, replace
from ..core.system import System
from .ensemble_table import EnsembleTable
from .make_hardware import driven
from .parameters import check_value
from .schema import Study

Part = Literal["tune", "margins", "holdout"]

LEAST_INSIDE = 0.01
"""Least probability that a normal draw is within the limits of its parameter."""


class Stage(eqx.Module):
    """Plant and sensor of a loop; an ensemble varies both.

    ``holding`` are the inputs under which the plant rests at the beginning of each
    reference, if these are known.
    """

    plant: System
    sensor: System
    holding: Float[Array, "*begins"] | None = None

    def around(self, loop: Feedback) -> Feedback:
        """Return ``loop`` with its plant and sensor replaced by those of this stage."""
        return Feedback(loop.controller, self.plant, loop.actuator, self.sensor)


@dataclass(frozen=True)
class Ensemble:
    """Random stages around a nominal stage.

    ``make`` builds a catalogued plant from its deviations, whose names are
    ``arguments``; it is None if no deviation is varied. ``paths`` are the varied
    parameters of the Stage. ``errors`` maps paths in the Stage to standard errors.
    Their draws outside the declared limits of the parameter are drawn again. ``notes``
    name the parameters of the fit that are not drawn.
    """

    study: Study
    nominal: Stage
    make: Callable[..., System] | None
    arguments: tuple[str, ...]
    paths: tuple[str, ...]
    errors: Mapping[str, float]
    notes: tuple[str, ...] = ()

    def stages(self, part: Part) -> Stage | None:
        """Return the drawn stages of ``part``, stacked along a leading axis.

        The first stages of "margins" are those of "tune". "holdout" has its own random
        stream. Returns None if the part has no stages.
        """
        table = self.study.ensemble
        assert table is not None
        count = getattr(table, part)
        if part == "margins":
            count = max(count, table.tune)
        if count == 0:
            return None
        stream = 3 if part == "holdout" else 2
        random, normals = (
            np.random.default_rng(
                np.random.SeedSequence(self.study.seed, spawn_key=(stream, *more))
            )
            for more in ((), (1,))
        )
        names = (*self.arguments, *self.paths)
        draws = random.uniform(-1.0, 1.0, (count, len(names), self.study.axis_count))
        middles, halves = np.reshape([self._interval(n) for n in names], (-1, 2)).T
        draws = middles[:, None] + halves[:, None] * draws
        if self.study.axes is None:
            draws = draws[..., 0]
        normal = self._normal(normals, count)
        return jax.vmap(self._stage)(as_array(draws), as_array(normal))

    def _normal(self, random: np.random.Generator, count: int) -> np.ndarray:
        """Return draws [count, errors] that keep the parameters within their limits."""
        found = random.standard_normal((count, len(self.errors)))
        for column, (path, error) in zip(found.T, self.errors.items(), strict=True):
            limits, value = declared(self.nominal, path), float(get(self.nominal, path))
            if limits is None:
                continue
            while (lost := ~limits.holds(value + error * column)).any():
                column[lost] = random.standard_normal(lost.sum())
        return found

    def _interval(self, name: str) -> tuple[float, float]:
        """Return the centre and the half width of the interval of ``name``."""
        table = self.study.ensemble
        assert table is not None
        if name in table.range:
            low, high = table.range[name]
            return 0.5 * (low + high), 0.5 * (high - low)
        return 0.0, table.spread.get(name, 0.0)

    def _stage(self, row: Array, normal: Array) -> Stage:
        stage = self.nominal
        if self.make is not None:
            own = dict(zip(self.arguments, row, strict=False))
            stage = Stage(self.make(**own), stage.sensor)
        table = self.study.ensemble
        assert table is not None
        values: dict[str, Any] = {}
        for name, draw in zip(self.paths, row[len(self.arguments) :], strict=True):
            nominal = get(stage, name)
            values[name] = draw if name in table.range else nominal * (1.0 + draw)
        for (name, error), draw in zip(self.errors.items(), normal, strict=True):
            values[name] = get(stage, name) + error * draw
        return replace(stage, values)


def ensemble_of(
    study: Study, nominal: Stage, folder: Path, amplifier: System | None = None
) -> Ensemble | None:
    """Return the ensemble of ``study``, or None if the study has none.

    Drawn plants stand behind the same ``amplifier`` as the nominal one. The files that
    the study names lie in ``folder``. Raises ValueError for an unknown deviation or
    path, for a file without standard errors, and for a standard error with which less
    than ``LEAST_INSIDE`` of the draws are within the limits of the parameter.
    """
    table = study.ensemble
    if table is None:
        return None
    varied = (*table.spread, *table.range)
    paths = tuple(name for name in varied if "." in name)
    make: Callable[..., System] | None = None
    arguments: tuple[str, ...] = ()
    if len(paths) < len(varied):
        name = str(study.plant.get("catalog", ""))
        known = deviations_of(name)
        if not known:
            plants = ", ".join(plant for plant in PLANTS if deviations_of(plant))
            raise ValueError(
                "ensemble: plant.catalog must be one whose variations are known: "
                f"{plants}; for other plants give paths, such as plant.0.a"
            )
        make = _behind(amplifier, PLANTS[name])
        for deviation in varied:
            if "." not in deviation and deviation not in known:
                key = "spread" if deviation in table.spread else "range"
                raise ValueError(
                    f"ensemble.{key}.{deviation} is unknown; {name} varies in "
                    f"{', '.join(known)}"
                )
        arguments = tuple(argument for argument in known if argument in varied)
    for path in paths:
        key = "spread" if path in table.spread else "range"
        _check_path(nominal, path, f"ensemble.{key}")
        _check_ends(nominal, path, table, f"ensemble.{key}.{path}")
    errors, held = (
        _standard_errors(folder / table.standard_errors, nominal)
        if table.standard_errors
        else ({}, [])
    )
    held = [name for name in held if name not in paths]
    note = (
        f"ensemble.standard_errors: {table.standard_errors} has no standard error of "
        f"{', '.join(held)}, which the record does not determine: all drawn plants "
        "have the values of the fit; vary them in ensemble.spread"
    )
    return Ensemble(
        study, nominal, make, arguments, paths, errors, (note,) if held else ()
    )


def _behind(
    amplifier: System | None, make: Callable[..., System]
) -> Callable[..., System]:
    """Return a function that puts the plants of ``make`` behind ``amplifier``."""

    def made(**deviations: Any) -> System:
        return driven(amplifier, make(**deviations))

    return made


def _check_path(stage: Stage, path: str, where: str) -> None:
    try:
        leaf = get(stage, path)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    if jnp.ndim(leaf):
        raise ValueError(f"{where}.{path} has shape {leaf.shape}; it must be a number")


def _check_ends(stage: Stage, path: str, table: EnsembleTable, where: str) -> None:
    """Raise ValueError if a constructor refuses an end of the interval of ``path``."""
    part, inner = path.split(".", 1)
    system, value = getattr(stage, part), float(get(stage, path))
    spread = table.spread.get(path, 0.0)
    ends = table.range.get(path, (value * (1.0 - spread), value * (1.0 + spread)))
    for end in ends:
        check_value(system, inner, end, where)


class _Estimate(BaseModel):
    value: float
    standard_error: float | None


class _Estimates(BaseModel):
    parameters: dict[str, _Estimate]


def _standard_errors(path: Path, nominal: Stage) -> tuple[dict[str, float], list[str]]:
    """Read the standard errors of a fit file.

    Return them by path in the Stage, and the paths of parameters without one.
    """
    try:
        estimates = read_model(_Estimates, path, "is not a fit file").parameters
    except ValueError as error:
        raise ValueError(f"ensemble.standard_errors: {error}") from None
    errors = {
        f"plant.{name}": estimate.standard_error
        for name, estimate in estimates.items()
        if estimate.standard_error is not None and np.isfinite(estimate.standard_error)
    }
    if not errors:
        raise ValueError(f"ensemble.standard_errors: {path} holds no standard error")
    for name, error in errors.items():
        _check_path(nominal, name, "ensemble.standard_errors")
        _check_inside(nominal, name, error)
    # A fit also names the states before its records, which no plant has.
    own = {f"plant.{name}" for name in parameters(nominal.plant)}
    held = [f"plant.{name}" for name in estimates]
    return errors, [name for name in held if name in own and name not in errors]


def _check_inside(stage: Stage, path: str, error: float) -> None:
    """Raise ValueError if few normal draws are within the limits of ``path``."""
    limits, value = declared(stage, path), float(get(stage, path))
    if limits is None or error == 0.0:
        return
    low, high = max(limits.above, limits.least), min(limits.below, limits.most)
    inside = ndtr((high - value) / error) - ndtr((low - value) / error)
    if not inside >= LEAST_INSIDE:
        raise ValueError(
            f"ensemble.standard_errors: {path} is {value:g} with a standard error of "
            f"{error:g}, but its limits are {low:g} and {high:g}: the record does not "
            "determine it; give its ensemble.range instead"
        )
