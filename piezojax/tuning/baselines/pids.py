"""PIDs by rules, evaluated in the loop of a study with its own objective."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...control import PID
from ...core.arrays import as_array
from ...core.feedback import Feedback
from ...core.paths import get
from ...core.space import Range, space_of
from ...solve.clock import Clock
from ...solve.history import History, batch_loss
from ...study import Case
from ..objective import Objective
from .experiments import RELAY, SIGMAS, STEP, ultimate_by_gain, ultimate_by_relay
from .rules import TYREUS_LUYBEN, ZIEGLER_NICHOLS, Rule, Ultimate

PATHS = tuple(
    f"controller.{name}"
    for name in (
        "proportional",
        "integral",
        "derivative",
        "derivative_filter",
        "anti_windup",
    )
)


class RulePID(NamedTuple):
    """PID by a rule: its name, its history, its loop, and its gains by path."""

    name: str
    history: History
    loop: Feedback
    gains: dict[str, float]


def rule_pids(objective: Objective, case: Case) -> tuple[list[RulePID], list[str]]:
    """Return the PIDs by rules for a case with their losses, and notes on failures.

    The ultimate gain gives the rules of Ziegler and Nichols. The relay gives theirs and
    those of Tyreus and Luyben, which are slower. The loop is the study's own, with the
    same stage, actuator, sensor, noise, signals and scale: only the controller differs.
    A note names an experiment that failed, and the reason.
    """
    if case.study.axes is not None:
        return [], ["rules for a PID: they need a stage with one axis"]
    experiments = {
        "ultimate gain": (_by_gain, _named("Ziegler-Nichols", ZIEGLER_NICHOLS)),
        "relay": (
            _by_relay,
            _named("relay, Ziegler-Nichols", ZIEGLER_NICHOLS)
            | _named("relay, Tyreus-Luyben", TYREUS_LUYBEN),
        ),
    }
    found: list[RulePID] = []
    notes: list[str] = []
    for name, (experiment, rules) in experiments.items():
        clock = Clock()
        try:
            ultimate = experiment(objective, case, clock)
        except ValueError as error:
            notes.append(f"{name}: {error}")
            continue
        found += evaluate_rules(objective, ultimate, rules, case.study.dt, clock)
    return found, notes


def _named(name: str, rules: Mapping[str, Rule]) -> dict[str, Rule]:
    return {f"{name} {kind}": rule for kind, rule in rules.items()}


def _by_gain(objective: Objective, case: Case, clock: Clock) -> Ultimate:
    study = case.study
    return ultimate_by_gain(
        case.loop,
        step=STEP * study.by_axis(study.references.amplitude)[0],
        span=float(objective.voltage_span),
        dt=study.dt,
        samples=objective.signals.references.shape[1],
        clock=clock,
    )


def _by_relay(objective: Objective, case: Case, clock: Clock) -> Ultimate:
    return ultimate_by_relay(
        case.loop,
        height=RELAY * float(objective.voltage_span),
        hysteresis=SIGMAS * case.study.by_axis(case.study.sensor.noise_rms)[0],
        dt=case.study.dt,
        noise=np.asarray(objective.signals.noise[0, 0]),
        clock=clock,
    )


def evaluate_rules(
    objective: Objective,
    ultimate: Ultimate,
    rules: Mapping[str, Rule],
    dt: float,
    clock: Clock,
) -> list[RulePID]:
    """Return the PID of each rule with its loss, from one batch of simulations."""
    loops = {
        name: _around(objective.loop, rule.pid(ultimate, dt))
        for name, rule in rules.items()
    }
    values = np.array([[get(loop, path) for path in PATHS] for loop in loops.values()])
    # A common box lets one program run all PIDs: each number from 0 to twice the
    # largest, or to 1 where every rule has 0.
    upper = np.where(values.max(axis=0) > 0.0, 2.0 * values.max(axis=0), 1.0)
    space = space_of(
        {path: Range(0.0, high) for path, high in zip(PATHS, upper, strict=True)}
    )
    in_box = replace(objective, loop=next(iter(loops.values())), space=space)
    units = as_array(values / upper)
    losses = np.asarray(batch_loss(in_box, units, clock)(units))
    found = []
    for (name, loop), row, loss in zip(loops.items(), values, losses, strict=True):
        history = History(clock)
        history.add(1, float(loss))
        gains = dict(zip(PATHS, map(float, row), strict=True))
        found.append(RulePID(name, history, loop, gains))
    return found


def _around(loop: Feedback, pid: PID) -> Feedback:
    return Feedback(pid, loop.plant, loop.actuator, loop.sensor)
