"""A fast stage for tests: a lag of 0.1 um/V with a PID controller, at 1 kHz."""

import threading
from contextlib import contextmanager

import numpy as np
import tomli_w

import piezojax as pj
from piezojax.control import PID
from piezojax.core.serial import save
from piezojax.dynamics import FirstOrderLag
from piezojax.hardware import Saturation, Sensor
from piezojax.stages import EmulatedStage, Limits, StageServer

DT = 1e-3
LIMITS = Limits(-10.0, 110.0, 5000.0, largest_error=2.0, retreat=0.0)
SAFE = {"proportional": 0.5, "integral": 500.0}
REFERENCE = 3.0 - 3.0 * np.cos(2.0 * np.pi * 2.0 * DT * np.arange(1000))


def lag(gain=0.1):
    return FirstOrderLag(5e-3, DT) >> pj.Affine(gain)


def stage(**changed):
    parts = {
        "controller": PID(1.0, 800.0, 0.0, dt=DT),
        "plant": lag(),
        "actuator": Saturation(-10.0, 110.0),
        "sensor": Sensor(1e-3),
        "limits": LIMITS,
        "dt": DT,
        "safe_gains": SAFE,
        "clock": lambda: 0.0,
    }
    return EmulatedStage(**(parts | changed))


STUDY = {
    "title": "a PID to retune",
    "rate": 1.0 / DT,
    "seed": 3,
    "plant": {"file": "model.json"},
    "actuator": {"lower": -10.0, "upper": 110.0},
    "sensor": {"noise_rms": 1e-3},
    "controller": {
        **{"type": "PID", "proportional": 1.0, "integral": 800.0, "dt": DT},
        "derivative": 0.0,
    },
    "references": {
        **{"tune": ["SIN2"], "unseen": ["SIN4"], "amplitude": 3.0},
        **{"duration": 1.0, "settle": 0.5},
    },
    "parameters": {
        "controller.proportional": {"lower": 0.1, "upper": 50.0, "scale": "log"},
        "controller.integral": {"lower": 50.0, "upper": 2e4, "scale": "log"},
    },
    "optimiser": {"starts": 1, "candidates": 4, "steps": 15},
}
"""Study of the stage, with references of the same range."""


def write_study(folder, plant=None, errors=None, **tables):
    """Write the study, and the model of its plant as if it were fitted."""
    if plant is None:
        plant = pj.series(lag=FirstOrderLag(5e-3, DT), calibration=pj.Affine(0.1))
        errors = {"lag.time_constant": 1e-5, "calibration.gain": 1e-4}
    known = {"standard_errors": errors, "input_ranges": [(0.0, 80.0)]}
    save(plant, folder / "model.json", pj.About(rate_Hz=1.0 / DT, **known))
    path = folder / "study.toml"
    path.write_text(tomli_w.dumps(STUDY | tables), encoding="utf-8")
    return path


@contextmanager
def served(one):
    """Yield the address at which ``one`` is served."""
    with StageServer(one) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server.address
        finally:
            server.shutdown()
            thread.join()
