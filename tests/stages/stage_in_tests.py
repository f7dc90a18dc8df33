"""A fast stage for tests: a lag of 0.1 um/V with a PID controller, at 1 kHz."""

import numpy as np

import piezojax as pj
from piezojax.control import PID
from piezojax.dynamics import FirstOrderLag
from piezojax.hardware import Saturation, Sensor
from piezojax.stages import EmulatedStage, Limits

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
