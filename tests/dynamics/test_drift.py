import jax
import numpy as np
import pytest

from piezojax import (
    simulate,
)
from piezojax.core.select import (
    Select,
)
from piezojax.dynamics import (
    ExponentialCreep,
    FirstOrderLag,
    ThermalDrift,
)
from piezojax.hysteresis import (
    ColemanHodgdon,
)

DT = 0.5
HYSTERESIS = ColemanHodgdon(0.0077, 0.1167, -0.0487)
STAGE = HYSTERESIS + ExponentialCreep((1e-3,), (30.0,), DT, direct=0.0) >> (
    FirstOrderLag(0.2, DT)
)
DRIFT = ThermalDrift(0.15, 40.0, 22.0, DT)


@jax.jit
def response(system, inputs, start):
    return simulate(system, inputs, system.init(start))[1]


def test_a_temperature_step_expands_the_stage_slowly():
    time = DT * np.arange(1, 401)
    found = response(DRIFT, np.full(400, 25.0), 22.0)
    expected = 0.15 * 3.0 * (1.0 - np.exp(-time / 40.0))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_voltage_and_temperature_drive_one_stage():
    index = np.arange(300)
    u, t = 40.0 + 20.0 * np.sin(0.05 * index), 22.0 + 0.01 * index
    both = (Select(0) >> STAGE) + (Select(1) >> DRIFT)
    found = response(both, (u, t), (40.0, 22.0))
    expected = response(STAGE, u, 40.0) + response(DRIFT, t, 22.0)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert abs(found[-1] - response(STAGE, u, 40.0)[-1]) > 0.2


def test_at_constant_temperature_there_is_no_drift():
    both = (Select(0) >> STAGE) + (Select(1) >> DRIFT)
    found = response(both, (np.full(20, 40.0), np.full(20, 23.0)), (40.0, 23.0))
    np.testing.assert_allclose(found, found[0], atol=1e-12)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ThermalDrift(1.0, 0.0, 22.0, DT), "time_constant in s is 0"),
        (lambda: ThermalDrift(np.nan, 1.0, 22.0, DT), "expansion in um/K is nan"),
        (lambda: ThermalDrift(1.0, 1.0, 22.0, -1.0), "dt in s is -1"),
        (lambda: Select(-1), "index is -1; it must be whole and at least 0"),
    ],
)
def test_bad_parameters(build, message):
    with pytest.raises(ValueError, match=message):
        build()
