"""A fit whose hysteresis has no inverse says so."""

import numpy as np
import pytest

import piezojax as pj
from piezojax.dynamics import FirstOrderLag
from piezojax.hysteresis import DahlFrictions
from piezojax.identification.make_fit import _without_inverse
from piezojax.identification.records.record import Record

INPUT = 50.0 - 40.0 * np.cos(0.05 * np.arange(400))
RECORD = Record(INPUT, 0.1 * INPUT, 1e-3)


def stage(height):
    """Return a friction whose slope after a turn is 1 - 0.4 height of the gain."""
    friction = DahlFrictions((0.1,), (height,), (0.2,), (1.0,))
    return pj.series(hysteresis=friction, lag=FirstOrderLag(2e-3, 1e-3))


def test_an_output_that_falls_after_a_turn_is_reported():
    (warning,) = _without_inverse(stage(4.0), [RECORD])
    assert "V, but inversion feedforward needs one: between" in warning
    scaled = Record(INPUT, 0.1 * INPUT, 1e-3, input_units="um")
    (warning,) = _without_inverse(stage(4.0), [scaled])
    assert "um, but inversion feedforward needs one: between" in warning


@pytest.mark.parametrize("system", [stage(1.0), FirstOrderLag(2e-3, 1e-3)])
def test_other_models_have_no_such_warning(system):
    assert _without_inverse(system, [RECORD]) == []
