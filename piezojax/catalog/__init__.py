"""Published stages and controllers, each number with its source.

"Printed" numbers, equations, tables and sections are those of Y. Cao's thesis (2013);
"ours" marks numbers that were chosen for piezojax.
"""

import inspect
from collections.abc import Callable, Mapping

from ..core.system import System
from . import mirror as mirror
from . import p558_actuators as p558_actuators
from . import p558_control as p558_control
from . import p558_stage as p558_stage
from . import p753 as p753
from . import p753_by_rate as p753_by_rate
from . import p753_chapter4 as p753_chapter4
from . import p753_inverses as p753_inverses
from . import p753_stage as p753_stage
from . import p753_survey as p753_survey

PLANTS: dict[str, Callable[..., System]] = {
    "p753": p753_by_rate.plant,
    "p753_chapter4": p753_by_rate.chapter4_plant,
    "p753_stage": p753_stage.stage,
    "p753_preisach": p753_inverses.preisach_plant,
    "p753_charge_driven": p753_survey.charge_driven_stage,
    "p558": p558_stage.plant,
    "p558_four_actuators": p558_actuators.four_actuators,
    "mirror": mirror.stage,
    "mirror_24_states": mirror.detailed_stage,
}
"""Plants by the name that a study uses. The positional arguments of a plant are the
deviations that an ensemble may draw; the docstring of the plant states whether one is
relative or absolute. On several axes each takes one value per axis."""

CONTROLLERS: dict[str, Callable[..., System]] = {
    "p753_pid": p753.pid,
    "p753_sliding_mode": p753.sliding_mode,
    "p753_inversion": p753_by_rate.inversion,
    "p753_preisach_inversion": p753_inverses.preisach_inversion,
    "p753_disturbance_observer": p753_by_rate.disturbance_observer,
    "p753_adaptive_disturbance_observer": p753.adaptive_disturbance_observer,
    "p753_anticipating_disturbance_observer": p753.anticipating_disturbance_observer,
    "p753_kalman_sliding_mode": p753.kalman_sliding_mode,
    "p753_kalman_disturbance_observer": p753.kalman_disturbance_observer,
    "p753_mixed_sensitivity": p753.mixed_sensitivity_inversion,
    "p753_model_reference": p753_chapter4.model_reference,
    "p753_anticipating_model_reference": p753_chapter4.anticipating_model_reference,
    "p753_traditional": p753_by_rate.traditional,
    "p753_bang_bang": p753_by_rate.bang_bang,
    "p753_continuous": p753_by_rate.continuous,
    "p753_pole_placement": p753_survey.pole_placement,
    "p753_boundary_layer": p753_survey.boundary_layer,
    "p753_super_twisting": p753_survey.super_twisting,
    "p753_phase_compensator": p753_survey.phase_compensator,
    "p753_feedforward": p753_survey.inverse_feedforward,
    "p753_feedforward_pid": p753_survey.feedforward_pid,
    "p753_feedforward_simc_pi": p753_survey.feedforward_simc_pi,
    "p753_feedforward_notch_pi": p753_survey.feedforward_notch_pi,
    "p753_feedforward_h_infinity": p753_survey.feedforward_h_infinity,
    "p753_adaptive_pi": p753_survey.adaptive_pi,
    "p753_preview_feedforward_pid": p753_survey.preview_feedforward_pid,
    "p753_repetitive": p753_survey.repetitive,
    "p753_iterative_learning": p753_survey.learning_control,
    "p753_ziegler_nichols": p753_by_rate.ziegler_nichols,
    "p558_pid": p558_control.pid,
    "p558_multi_axis": p558_control.multi_axis,
    "p558_anticipating_multi_axis": p558_control.anticipating_multi_axis,
    "p558_anticipating_disturbance_observer": (
        p558_control.anticipating_disturbance_observer
    ),
    "p558_state_sliding_mode": p558_control.state_sliding_mode,
    "p558_anticipating_state_sliding_mode": (
        p558_control.anticipating_state_sliding_mode
    ),
    "p558_nominal": p558_control.nominal,
    "p558_disturbance_observer": p558_control.disturbance_observer,
    "mirror_multi_axis": mirror.anticipating_multi_axis,
    "mirror_state_sliding_mode": mirror.anticipating_state_sliding_mode,
}
"""Controllers by the name that a study uses. Their gains are printed, unless the
docstring of the controller, of its constants or of its module says "ours" or names a
tuning rule. Those with an argument ``rate`` (Hz) are made for the rate of the study."""


def deviations_of(plant: str) -> tuple[str, ...]:
    """Return the names of the deviations that an ensemble may draw for a plant.

    They are the positional arguments of the catalogued plant; an unknown one has none.
    """
    if plant not in PLANTS:
        return ()
    return tuple(
        name
        for name, argument in inspect.signature(PLANTS[plant]).parameters.items()
        if argument.kind is argument.POSITIONAL_OR_KEYWORD
    )


def at_rate(
    catalog: Mapping[str, Callable[..., System]], name: str, rate: float | int
) -> System:
    """Return ``catalog[name]``, made for ``rate`` (Hz) if it has that argument.

    Raises ValueError for a rate without a printed model.
    """
    make = catalog[name]
    if "rate" not in inspect.signature(make).parameters:
        return make()
    whole = int(rate) == rate
    return make(rate=int(rate) if whole else rate)
