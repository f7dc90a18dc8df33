import jax.numpy as jnp
import numpy as np
import pytest

from piezojax.signals import motions
from piezojax.signals import waveforms as signals

AXES = ("Z", "Rx", "Ry")
TIME = signals.time_grid(1.0, 500.0)


def test_axes_without_a_signal_rest_at_their_offset():
    found = motions.motion(
        "Z:SIN2 Ry:SW10", TIME, AXES, (5.0, 6.0, 7.0), (1.0, 2.0, 3.0)
    )
    np.testing.assert_array_equal(found[:, 0], signals.signal("SIN2", TIME, 5.0, 1.0))
    np.testing.assert_array_equal(found[:, 1], jnp.full(TIME.size, 2.0))
    np.testing.assert_array_equal(found[:, 2], signals.signal("SW10", TIME, 7.0, 3.0))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("SIN10", r"'SIN10' must be an axis, one of Z, Rx, Ry, and a signal"),
        ("X:SIN10", r"'X:SIN10' must be an axis, one of Z, Rx, Ry"),
        ("Z:SIN1 Z:SIN5", r"drives Z twice"),
        ("  ", r"drives no axis"),
        ("Z:WAVE3", r"signal 'WAVE3' is unknown"),
        *(
            (word, "a{20}")
            for word in ("a" * 5000, f"Z+Rx:{'a' * 5000}", f"Z:{'a' * 5000}")
        ),
    ],
)
def test_bad_motions_are_refused(name, message):
    with pytest.raises(ValueError, match=message) as found:
        motions.parse(name, AXES)
    assert len(str(found.value)) < 500
