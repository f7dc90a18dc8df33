"""Published stages and controllers, each number with its source."""

from . import p753 as p753
from . import p753_chapter4 as p753_chapter4

PLANTS = {"p753": p753.plant}
"""Plants a study can name."""

CONTROLLERS = {
    "p753_pid": p753.pid,
    "p753_sliding_mode": p753.sliding_mode,
    "p753_inversion": p753.inversion,
    "p753_disturbance_observer": p753.disturbance_observer,
}
"""Controllers a study can name, with their printed gains."""
