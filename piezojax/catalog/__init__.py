"""Published stages and controllers, each number with its source."""

from . import p753 as p753
from . import p753_chapter4 as p753_chapter4

PLANTS = {"p753": p753.plant, "p753_chapter4": p753_chapter4.plant}
"""Plants a study can name."""

CONTROLLERS = {
    "p753_pid": p753.pid,
    "p753_sliding_mode": p753.sliding_mode,
    "p753_inversion": p753.inversion,
    "p753_disturbance_observer": p753.disturbance_observer,
    "p753_kalman_sliding_mode": p753.kalman_sliding_mode,
    "p753_kalman_disturbance_observer": p753.kalman_disturbance_observer,
    "p753_mixed_sensitivity": p753.mixed_sensitivity_inversion,
    "p753_model_reference": p753_chapter4.model_reference,
    "p753_traditional": p753_chapter4.traditional,
    "p753_bang_bang": p753_chapter4.bang_bang,
    "p753_continuous": p753_chapter4.continuous,
}
"""Controllers a study can name: printed gains, except where they say 'ours'."""
