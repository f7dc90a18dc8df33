"""The identified mirror in closed loop at 6.4 kHz."""

import json
import math

import jax.numpy as jnp
import numpy as np
import pytest

import piezojax as pj
from piezojax.catalog import mirror
from piezojax.core.axes import packed
from piezojax.core.feedback import loop_inputs
from piezojax.core.system import resolve

REST = (0.0, 0.0, 0.0)


@pytest.mark.parametrize("order", mirror.ORDERS)
def test_the_stage_is_the_model_with_a_sample_of_delay(order):
    model, stage = mirror.model(order), mirror.stage(order=order)
    drive = np.random.default_rng(0).standard_normal((200, 3))
    A, B, C, D = (np.asarray(getattr(model, name)) for name in "ABCD")
    x, expected = np.zeros(order), []
    for u in drive:
        expected.append(C @ x + D @ u)
        x = A @ x + B @ u
    inputs = tuple(jnp.asarray(column) for column in drive.T)
    _, log = pj.simulate(stage, inputs, stage.init((jnp.zeros(()),) * 3))
    np.testing.assert_allclose(packed(log), expected, atol=1e-9)
    np.testing.assert_allclose(stage.dc_gain(), model.dc_gain(), rtol=1e-8)


def test_an_unknown_order_is_refused():
    with pytest.raises(ValueError, match=r"order is 13; it must be one of \[12, 24\]"):
        mirror.model(13)


@pytest.fixture(scope="module")
def loop():
    return mirror.loop(mirror.multi_axis())


@pytest.mark.slow
def test_margins(loop):
    report = pj.stability_report(loop, REST)
    assert report.stable
    assert abs(report.poles[0]) == pytest.approx(0.960, abs=1e-3)
    assert report.disk_margin == pytest.approx(0.459, abs=1e-3)
    assert all(axis.disk_margin >= report.disk_margin for axis in report.axes)
    assert report.sensitivity_peak < 3.0
    json.dumps(report.as_dict(), allow_nan=False)


@pytest.mark.slow
def test_the_loop_follows_sines_and_starts_at_rest(loop):
    start = (0.2, -0.1, 0.3)
    time = mirror.DT * np.arange(3_200)
    sines = [0.5 * np.sin(2.0 * math.pi * hertz * time) for hertz in (10, 20, 30)]
    moving = np.array(start) + np.stack(sines, axis=-1)
    held = np.broadcast_to(start, moving.shape)
    for reference, most in ((held, 1e-9), (moving, (0.07, 0.13, 0.18))):
        _, log = pj.simulate(
            loop, loop_inputs(jnp.asarray(reference)), loop.init(start)
        )
        miss = np.stack(log.displacement, axis=-1) - reference
        assert np.all(np.sqrt(np.mean(miss[1_600:] ** 2, axis=0)) < most)


@pytest.mark.parametrize("order", mirror.ORDERS)
def test_state_tracking_is_stable_on_both_models(order):
    control = resolve(mirror.state_sliding_mode())
    F, G, H, K = (
        np.asarray(x) for x in (control.A, control.B, control.C, control.gain)
    )
    E = np.asarray(control.equivalent)
    model = mirror.model(order).delayed()
    A, B, C = (np.asarray(x) for x in (model.A, model.B, model.C))
    # x+ = A x + B u, u = E v; v+ = (1 - K H) (F v + G u) + K C x+.
    kept = np.eye(len(F)) - K @ H
    poles = np.linalg.eigvals(
        np.block([[A, B @ E], [K @ C @ A, kept @ (F + G @ E) + K @ C @ B @ E]])
    )
    expected = {12: 0.9956, 24: 0.9897}[order]
    assert np.abs(poles).max() == pytest.approx(expected, abs=1e-4)
