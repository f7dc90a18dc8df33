"""Designs of devices: stable before tuning, in the numbers that are typed in."""

import jax.numpy as jnp
import numpy as np
import pytest

import piezojax as pj
from piezojax.analysis.stability import stability_reports
from piezojax.catalog import p753, p753_stage
from piezojax.control.devices import DEVICE_DESIGNS, E727, NV200
from piezojax.core.system import Affine, rest_output
from piezojax.dynamics import FirstOrderLag, Mode

DT, LIMITS = 5e-5, (-20.0, 120.0)
PLANTS = {
    "stage": lambda: p753_stage.stage(delay=0.4),
    "lag": lambda: Affine(0.1, 2.0) >> FirstOrderLag(1e-3, DT),
    "slow sensor": lambda: (
        Affine(0.1) >> Mode(780.0, 0.02, DT) >> FirstOrderLag(1e-3, DT)
    ),
    "light mode": lambda: Affine(0.1) >> Mode(300.0, 0.005, DT),
}


def loop_around(device, plant):
    limits = pj.Saturation(*LIMITS)
    return pj.Feedback(device, plant, limits, pj.Sensor(0.0))


def designed(name, plant, **settings):
    return DEVICE_DESIGNS[name](plant, DT, LIMITS, **{"scale": 9.3} | settings)


@pytest.mark.parametrize("name", DEVICE_DESIGNS)
@pytest.mark.parametrize("plant", ["stage", "slow sensor", "light mode"])
def test_a_designed_device_is_stable_with_twice_the_gain(name, plant):
    stage = PLANTS[plant]()
    loop = loop_around(designed(name, stage), stage >> Affine(2.0))
    reference = 2.0 * float(rest_output(stage, 50.0))
    found = stability_reports({"after": loop}, reference).reports["after"]
    assert all(report.stable for report in found.values())


@pytest.mark.parametrize("name", DEVICE_DESIGNS)
def test_a_designed_device_follows_a_step(name):
    stage = PLANTS["slow sensor"]()
    references = jnp.where(jnp.arange(12_000) < 100, 5.0, 6.0)
    loop = loop_around(designed(name, stage), stage)
    state = loop.init(references[0], jnp.asarray(50.0))
    log = pj.simulate(loop, pj.loop_inputs(references), state)[1]
    error = np.asarray(log.displacement - references)
    assert np.abs(error[:100]).max() < 1e-9
    assert np.abs(error[-200:]).max() < 1e-2
    assert error.max() < 0.4


@pytest.mark.parametrize("scale", [2.5, 9.3])
def test_the_voltage_does_not_depend_on_the_scale(scale):
    stage = PLANTS["lag"]()
    first, other = (designed("nv200", stage, scale=x) for x in (10.0, scale))
    assert scale * other.ki == pytest.approx(10.0 * float(first.ki), rel=1e-9)
    assert scale * other.kp == pytest.approx(10.0 * float(first.kp), rel=1e-9)
    first, other = (designed("e727", stage, scale=x) for x in (10.0, scale))
    assert scale * other.proportional == pytest.approx(10.0 * float(first.proportional))
    assert other.integral_time == first.integral_time


def test_the_loop_does_not_depend_on_the_structure_of_the_device():
    stage = PLANTS["lag"]()
    loops = [
        designed("e727", stage, structure=each).loop()
        for each in ("unknown", "series", "parallel")
    ]
    gains = np.array([(x.proportional, x.integral, x.derivative) for x in loops])
    np.testing.assert_allclose(gains[1:], gains[:1].repeat(2, 0), rtol=1e-12)
    with pytest.raises(ValueError, match=r"structure is 'ideal'; .* series, parallel"):
        designed("e727", stage, structure="ideal")


def test_the_notch_lies_at_the_strongest_mode():
    modes = Affine(0.1) >> pj.dynamics.Modes((400.0, 900.0), (0.02, 0.02), DT, (0.8,))
    assert designed("nv200", modes).notchf == pytest.approx(900.0, rel=1e-3)
    assert designed("e727", modes).notch_frequency_1 == pytest.approx(900.0, rel=1e-3)
    # Without a mode it lies at a quarter of the rate.
    assert designed("nv200", PLANTS["lag"]()).notchf == pytest.approx(5000.0)


def test_the_notch_of_an_e727_lies_at_9_khz_for_a_mode_above():
    device = designed("e727", Affine(0.1) >> Mode(9100.0, 0.19, DT))
    assert isinstance(device, E727)
    assert device.notch_frequency_1 == 9000.0


def test_the_slope_of_a_refused_plant_contains_its_dynamics():
    with pytest.raises(ValueError, match=r"falls as the voltage rises, -0\.148\d* um"):
        designed("e727", p753.hysteresis() >> Affine(-1.0) >> FirstOrderLag(1e-3, DT))


def test_the_settings_are_those_of_the_device():
    stage = PLANTS["lag"]()
    device = designed("nv200", stage, slew=600.0, range=(0.0, 30.0))
    assert isinstance(device, NV200)
    # 600 um/s of 30 um are 2 % a millisecond.
    assert device.sr == pytest.approx(2.0)
    assert (device.posmin, device.posmax) == (0.0, 30.0)
    assert (device.avmin, device.avmax) == LIMITS
    assert designed("nv200", stage).sr == 2000.0  # off
    # The displacements at the limits are the range by default.
    assert designed("nv200", stage).posmax == pytest.approx(14.0)
    other = designed("e727", stage, slew=600.0)
    assert isinstance(other, E727)
    assert other.slew_rate == 600.0


def test_gains_stay_within_the_range_of_the_device():
    stage = PLANTS["lag"]()
    assert designed("nv200", stage, scale=0.5).ki == 1e4


def test_an_unknown_scale_is_assumed_with_a_caution():
    stage = PLANTS["lag"]()
    device = DEVICE_DESIGNS["nv200"](stage, DT, LIMITS)
    assert "the scale of the gains of the NV200 is assumed" in device.cautions[0]
    # 140 V over 14 um: as if the scale were 10.
    assert device.ki == pytest.approx(float(designed("nv200", stage, scale=10.0).ki))


@pytest.mark.parametrize("name", DEVICE_DESIGNS)
def test_plants_without_a_device_are_refused(name):
    with pytest.raises(ValueError, match=r"falls as the voltage rises, -0\.1 um/V"):
        designed(name, Affine(-0.1) >> FirstOrderLag(1e-3, DT))
    with pytest.raises(ValueError, match="runs at 20 kHz"):
        DEVICE_DESIGNS[name](Affine(0.1), 1e-4, LIMITS, scale=1.0)
