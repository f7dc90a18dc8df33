"""PIDs tuned by piezojax beside published rules and python-control, at equal Ms.

    python tests/benchmarks/rules.py [--plants 0:11] [--steps 100] [--json FILE]

Each plant is a stage with lags and a delay, without and with light modes. piezojax
tunes a PID, and one with notches at the light modes, under a limit on Ms. The rules
give a PID from the same plant; their gain is then raised or lowered until Ms is at the
limit. SIMC and the design with a phase margin have a free speed: the best of all speeds
counts. With "+ notch" a rule sees the plant behind notches that cancel the light modes
exactly, which the rule itself does not know. LQG (``control.dlqr`` and ``dlqe``) knows
the whole plant; so does H-infinity (``control.mixsyn``), if slycot is installed.

Every loop, tuned ones too, is judged by code that shares nothing with piezojax: Ms and
the rms error on references that no search has seen, with noise, from the frequency
response.

The bars: never worse than the best rule at equal Ms, and three times better where a
light mode limits the loop. How much it limits the rules is shown by the stage with well
damped modes in place of the light ones: the factor by which the best rule is better on
it.
"""

import argparse
import json
import sys
import tempfile
import time
from importlib.util import find_spec
from itertools import product
from pathlib import Path

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parent))

import rule_designs as rules
from rule_designs import LinearPlant, Mode

import piezojax as pj
from piezojax.study import Study, build

RATE = 10_000.0
DT = 1.0 / RATE
LIMIT = 1.8
GAIN, AMPLITUDE, NOISE = 0.1, 2.0, 1e-3
UNSEEN = ("SIN15", "SIN30", "TRI25")
BASE = Mode(4000.0, 0.7)
WIDTH = 0.5
"""Damping ratio of the poles of a notch beside a rule."""

BETTER = 3.0
CLOSE = 0.02
"""Relative error of Ms and of the error by which a bar may be missed."""


def stage(*light, lags=(2e-4,), delay=1):
    """Return a stage with ``light`` modes beside a well damped one."""
    rest = 1.0 - sum(mode.share for mode in light)
    return LinearPlant(GAIN, (BASE._replace(share=rest), *light), lags, delay, DT)


PLANTS = {
    "a lag": stage(lags=(2e-3,)),
    "two lags": stage(lags=(2e-3, 5e-4)),
    "four lags": stage(lags=(5e-4,) * 4),
    "a delay of 3 ms": stage(lags=(5e-4,), delay=30),
    "mode of 0.5 %": stage(Mode(800.0, 0.005, 0.9)),
    "mode of 1 %": stage(Mode(800.0, 0.01, 0.9)),
    "mode of 2 %": stage(Mode(800.0, 0.02, 0.9)),
    "mode of 5 %": stage(Mode(800.0, 0.05, 0.9)),
    "mode of 1 %, a third": stage(Mode(900.0, 0.01, 0.3), lags=(5e-4,)),
    "mode of 1 %, a delay": stage(Mode(800.0, 0.01, 0.5), delay=8),
    "two modes of 1 %": stage(Mode(600.0, 0.01, 0.4), Mode(1100.0, 0.01, 0.4)),
}


def study_of(name, plant, steps):
    """Return the study of a plant, with structures if it has light modes."""
    modes = {
        "type": "Modes",
        "frequency": [mode.frequency for mode in plant.modes],
        "damping": [mode.damping for mode in plant.modes],
        "share": [mode.share for mode in plant.modes[1:]],
        "time_constant": list(plant.lags),
        "dt": DT,
    }
    parts = [{"type": "Affine", "gain": GAIN}, modes]
    if plant.delay:
        parts.append({"type": "Delay", "samples": plant.delay})
    half = 4.0 * AMPLITUDE / GAIN

    def log(lower, upper):
        return {"lower": lower, "upper": upper, "scale": "log"}

    study = {
        "title": name,
        "rate": RATE,
        "seed": 5,
        "plant": {"type": "Series", "parts": parts},
        "actuator": {"lower": -half, "upper": half},
        "sensor": {"noise_rms": NOISE},
        "controller": {
            "type": "PID",
            "proportional": 1e-2 / GAIN,
            "integral": 10.0 / GAIN,
            "derivative": 1e-6 / GAIN,
            "derivative_filter": 1e-4,
            "dt": DT,
        },
        "references": {
            "tune": ["SIN20", "TRI20"],
            "amplitude": AMPLITUDE,
            "duration": 0.2,
            "settle": 0.1,
        },
        "parameters": {
            "controller.proportional": log(1e-3 / GAIN, 50.0 / GAIN),
            "controller.integral": log(1.0 / GAIN, 2e4 / GAIN),
            "controller.derivative": log(1e-7 / GAIN, 0.1 / GAIN),
            "controller.derivative_filter": log(1e-5, 1e-2),
        },
        "constraints": {"sensitivity_peak": LIMIT, "delay_margin": "off"},
        "optimiser": {"steps": steps},
    }
    light = len(plant.modes) - 1
    if light:
        study["structures"] = {"notches": list(range(light + 1))}
    return study


PARTS = ("proportional", "integral", "derivative", "derivative_filter")


def controller_of(gains, angle):
    """Return the response of a tuned PID with its notches."""
    notches = sorted({p.split(".")[-2] for p in gains if ".filter." in p})
    inner = "controller.controller" if notches else "controller"
    pid = [gains[f"{inner}.{part}"] for part in PARTS]
    found = rules.pid_response(angle, DT, *pid)
    for notch in notches:
        one = [
            gains[f"controller.filter.{notch}.{part}"]
            for part in ("frequency", "damping", "depth")
        ]
        found = found * rules.notch_response(angle, DT, *one)
    return found


def tuned(name, plant, steps):
    """Return the gains of the PID and of that with the most notches, and the alarms."""
    case = build(Study.model_validate(study_of(name, plant, steps)), "rules.toml")
    result = pj.tune(case).result
    if result.structures is None:
        return {"PID": result.gains}, result.alarms
    rows = [one for one in result.structures.structures if one.gains]
    most = max(rows, key=lambda one: one.notches)
    if not most.notches:
        return {"PID": rows[0].gains}, result.alarms  # no mode limits the loop
    return {"PID": rows[0].gains, "PID + notch": most.gains}, result.alarms


def judged(plant, angle, L, controller_at):
    """Return error (nm) and Ms of a loop, error infinite if it is not stable."""
    if not rules.is_stable(angle, L):
        return {"nm": np.inf, "Ms": np.inf}

    def loop_at(where):
        return controller_at(where) * plant.response(where)

    found = rules.error(loop_at, UNSEEN, AMPLITUDE, NOISE, DT)
    return {"nm": 1e3 * found, "Ms": rules.peak(L)}


def calmed(plant):
    """Return the plant with well damped modes in place of its light ones."""
    base, *light = plant.modes
    damped = [mode._replace(damping=WIDTH) for mode in light]
    return plant._replace(modes=(base, *damped))


def by_rules(plant, angle):
    """Return the loops of each rule at the limit on Ms, without and with notches."""
    P, found = plant.response(angle), {}
    light = plant.modes[1:]
    step = plant.step_response(6000)

    def notched(where):
        response = np.ones(len(where), complex)
        for mode in light:
            depth = mode.damping / WIDTH
            notch = rules.notch_response(where, DT, mode.frequency, WIDTH, depth)
            response = response * notch
        return response

    for suffix, filtered, seen in (
        ("", lambda where: np.ones(len(where)), step),
        (" + notch", notched, calmed(plant).step_response(6000)),
    ):
        if suffix and not light:
            continue
        own = P * filtered(angle)
        model = rules.first_order(seen, DT)
        ultimate = rules.ultimate(plant, angle, own)
        speeds = model.delay * np.geomspace(0.5, 50.0, 20)
        candidates = {
            "Ziegler-Nichols PI": [rules.ziegler_nichols_pi(*ultimate)],
            "Ziegler-Nichols PID": [rules.ziegler_nichols_pid(*ultimate)],
            "AMIGO PI": [rules.amigo_pi(model)],
            "AMIGO PID": [rules.amigo_pid(model)],
            "SIMC PI": [rules.simc_pi(model, closed) for closed in speeds],
            "SIMC PID": [rules.simc_pid(model, closed) for closed in speeds],
            "60 degrees PI(D)": [
                rules.phase_margin_pid(own[i], angle[i] / DT)
                for i in range(0, len(angle), 12)
            ],
        }
        for name, pids in candidates.items():
            best = {"nm": np.inf, "Ms": np.inf}
            for pid in filter(None, pids):
                gains = pid.gains()
                L = rules.pid_response(angle, DT, *gains) * own
                factor = rules.limited_gain(L, LIMIT)
                if not np.isfinite(factor):
                    continue

                def controller_at(where, gains=gains, factor=factor, filtered=filtered):
                    pid = rules.pid_response(where, DT, *gains)
                    return factor * pid * filtered(where)

                one = judged(plant, angle, factor * L, controller_at)
                best = min(best, one, key=lambda each: each["nm"])
            found[name + suffix] = best
    return found


def by_python_control(plant, angle):
    """Return the best LQG and H-infinity loops with Ms at most the limit.

    They are scaled down where Ms is above it. Without slycot there is no H-infinity.
    """
    P = plant.response(angle)
    designs = {
        "LQG": (
            rules.lqg_response,
            product(np.geomspace(1e-1, 1e6, 15), (1e-4, 1e-2, 1.0)),
        )
    }
    if find_spec("slycot"):
        speeds = 2.0 * np.pi * np.geomspace(10.0, 600.0, 9)
        designs["H-infinity"] = rules.h_infinity_response, product(speeds, (0.03, 0.3))
    found = {}
    for name, (design, settings) in designs.items():
        best = {"nm": np.inf, "Ms": np.inf}
        for setting in settings:
            try:
                L = design(plant, angle, *setting) * P
            except (ValueError, ArithmeticError, np.linalg.LinAlgError):
                continue  # no controller for these weights
            factor = min(1.0, rules.limited_gain(L, LIMIT))

            def controller_at(where, design=design, setting=setting, factor=factor):
                return factor * design(plant, where, *setting)

            one = judged(plant, angle, factor * L, controller_at)
            best = min(best, one, key=lambda each: each["nm"])
        found[name] = best
    return found


def line_of(name, plant, steps):
    """Return all loops of a plant, by the name of the controller."""
    began, angle = time.perf_counter(), plant.grid()
    P = plant.response(angle)
    found = by_rules(plant, angle) | by_python_control(plant, angle)
    gains, alarms = tuned(name, plant, steps)
    for which, values in gains.items():

        def controller_at(where, values=values):
            return controller_of(values, where)

        found[f"piezojax {which}"] = judged(
            plant, angle, controller_at(angle) * P, controller_at
        )
    light, calm = len(plant.modes) - 1, calmed(plant)
    return {
        "plant": name,
        "light": light,
        "loops": found,
        "calmed": by_rules(calm, calm.grid()) if light else {},
        "gains": gains,
        "alarms": alarms,
        "seconds": time.perf_counter() - began,
    }


def best_of(loops, ending):
    """Return name and error of the best rule, with notches or without."""
    some = {
        name: loop["nm"]
        for name, loop in loops.items()
        if not name.startswith(("piezojax", "LQG", "H-inf"))
        and name.endswith(" + notch") == ending
    }
    name = min(some, key=some.get, default=None)
    return (name, some[name]) if name else ("-", np.nan)


def table_of(lines):
    """Return the table: errors in nm at equal Ms."""
    table = Table(title=f"rms error, nm, on unseen references; Ms at most {LIMIT}")
    designs = [name for name in ("LQG", "H-infinity") if name in lines[0]["loops"]]
    heads = ("best rule", "", "rule + notch", "", *designs, "PID", "PID + notch")
    for head in ("plant", *heads, "Ms", "better"):
        table.add_column(head, justify="left" if "rule" in head else "right")
    for line in lines:
        loops = line["loops"]
        (one, error), (other, with_notch) = best_of(loops, False), best_of(loops, True)
        pid = loops["piezojax PID"]
        notch = loops.get("piezojax PID + notch")
        ours = notch or pid
        table.add_row(
            line["plant"],
            one,
            f"{error:.4g}",
            other.removesuffix(" + notch"),
            f"{with_notch:.4g}",
            *(f"{loops[design]['nm']:.4g}" for design in designs),
            f"{pid['nm']:.4g}",
            f"{notch['nm']:.4g}" if notch else "-",
            f"{ours['Ms']:.3f}",
            f"{error / ours['nm']:.2f}x",
        )
    return table


def summary(lines):
    """Return the bars and what was reached, one sentence a line."""
    worse, small, notched = [], [], []
    for line in lines:
        loops, name = line["loops"], line["plant"]
        rule, filtered = best_of(loops, False)[1], best_of(loops, True)[1]
        if loops["piezojax PID"]["nm"] > rule * (1.0 + CLOSE):
            worse.append(name)
        with_notch = loops.get("piezojax PID + notch")
        if with_notch and rule / with_notch["nm"] < BETTER:
            small.append(name)
        if with_notch and with_notch["nm"] > filtered * (1.0 + CLOSE):
            notched.append(name)
    over = [
        f"{line['plant']}: {which}"
        for line in lines
        for which, loop in line["loops"].items()
        if which.startswith("piezojax") and not loop["Ms"] <= LIMIT * (1.0 + CLOSE)
    ]
    light = [line for line in lines if "piezojax PID + notch" in line["loops"]]
    costs = [
        f"{line['plant']} "
        f"{best_of(line['loops'], False)[1] / best_of(line['calmed'], False)[1]:.2f}x"
        for line in lines
        if line["calmed"]
    ]
    return [
        f"PID worse than the best rule at equal Ms: {len(worse)} of {len(lines)} "
        f"(bar 0) {worse}",
        f"PID + notch less than {BETTER:g} times better than the best rule where a "
        f"light mode limits the loop: {len(small)} of {len(light)} (bar 0) {small}",
        f"best rule better with well damped modes: {', '.join(costs)}",
        f"PID + notch worse than the best rule behind the exact notch: {len(notched)} "
        f"of {len(light)} {notched}",
        f"Ms above the limit: {len(over)} {over}",
        f"{sum(line['seconds'] for line in lines):.0f} s",
    ]


def main():
    """Judge the plants and print one table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--plants", default=f"0:{len(PLANTS)}", metavar="FIRST:STOP")
    parser.add_argument("--steps", type=int, default=100, help="of a search, at most")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    first, stop = map(int, arguments.plants.split(":"))
    console, lines = Console(width=140), []
    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
        for name, plant in list(PLANTS.items())[first:stop]:
            lines.append(line_of(name, plant, arguments.steps))
            shown = {n: f"{one['nm']:.4g}" for n, one in lines[-1]["loops"].items()}
            console.print(f"{name}: {shown}", soft_wrap=True, highlight=False)
            if arguments.json:
                arguments.json.write_text(json.dumps(lines, indent=1), encoding="utf-8")
    console.print(table_of(lines))
    for sentence in summary(lines):
        console.print(sentence, soft_wrap=True, highlight=False)


if __name__ == "__main__":
    main()
