import numpy as np
import pytest

from piezojax.catalog import p753, p753_inverses
from piezojax.control import (
    InversionControl,
)
from piezojax.hysteresis import (
    InverseColemanHodgdon,
    InversePreisach,
)

INPUT = p753_inverses.excitation()[::40]  # 100 Hz in 2000 samples: coarse, but rich


@pytest.fixture(scope="module")
def record():
    return p753_inverses.record_of(p753.plant(), INPUT)


def test_the_excitation_starts_at_rest_and_stays_in_range():
    full = p753_inverses.excitation()
    low, high = p753.VOLTAGE_LIMITS
    assert full[0] == 0.0
    assert low < full.min() < low + 5.0
    assert high - 5.0 < full.max() < high


def test_the_preisach_stage_has_the_size_of_the_printed_one():
    model = p753_inverses.preisach(8)
    path = np.concatenate([np.linspace(0.0, 120.0, 61), np.linspace(120.0, -20.0, 71)])
    output = np.asarray(p753_inverses.response(model, path))
    assert abs(output[0]) < 1e-12  # at rest at 0 V and 0 um
    printed = np.asarray(p753_inverses.response(p753.hysteresis(), path))
    assert 0.9 < np.ptp(output) / np.ptp(printed) < 1.2


def test_the_printed_hysteresis_is_recovered(record):
    found = p753_inverses.fitted_coleman_hodgdon(record)
    for name, value in p753.HYSTERESIS_CHAPTER_5.items():
        np.testing.assert_allclose(getattr(found, name), value, rtol=0.02)
    np.testing.assert_allclose(found.rest_output, 0.0, atol=0.005)


def test_both_inverses_work_in_the_printed_controller(record):
    model = p753_inverses.fitted_preisach(record, 6)
    assert (model.low, model.high) == p753.VOLTAGE_LIMITS
    assert np.all(model.weights >= 0.0)
    output = np.asarray(p753_inverses.response(model, INPUT))
    true = np.asarray(p753_inverses.response(p753.hysteresis(), INPUT))
    assert np.sqrt(np.mean((output - true) ** 2)) < 0.15  # of 19 um
    for inverse in (
        InversePreisach(model),
        InverseColemanHodgdon(p753_inverses.fitted_coleman_hodgdon(record)),
    ):
        assert InversionControl(p753.inversion().feedback, inverse).inverse is inverse
