"""Published stages and controllers, each number with its source."""

from . import p753 as p753
from . import p753_chapter4 as p753_chapter4
from . import p753_survey as p753_survey

PLANTS = {"p753": p753.plant, "p753_chapter4": p753_chapter4.plant}
"""Plants a study can name."""

CONTROLLERS = {
    "p753_pid": p753.pid,
    "p753_sliding_mode": p753.sliding_mode,
    "p753_inversion": p753.inversion,
    "p753_disturbance_observer": p753.disturbance_observer,
    "p753_model_reference": p753_chapter4.model_reference,
    "p753_traditional": p753_chapter4.traditional,
    "p753_bang_bang": p753_chapter4.bang_bang,
    "p753_continuous": p753_chapter4.continuous,
    "p753_boundary_layer": p753_survey.boundary_layer,
    "p753_super_twisting": p753_survey.super_twisting,
    "p753_feedforward": p753_survey.inverse_feedforward,
    "p753_feedforward_pid": p753_survey.feedforward_pid,
    "p753_repetitive": p753_survey.repetitive,
}
"""Controllers a study can name: with the printed gains, or where there are none
(``p753.pid``, ``p753_survey``) with ours."""
