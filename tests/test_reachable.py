"""Every scheme of the thesis can be named in a study file."""

import pytest
import tomli_w

from piezojax.catalog import p753, p753_survey
from piezojax.control import AlphaBeta, SlidingMode, SwitchingPID
from piezojax.core.paths import get
from piezojax.core.serial import to_data
from piezojax.dynamics import ARMA
from piezojax.study import read

DT = p753.DT
LAW = "controller.law.integral"
PID = "controller.feedback.integral"
THIRD = SlidingMode(
    SwitchingPID(0.01, 30.0, 1e-6, dt=DT, anti_windup=400.0),
    model=ARMA((1.9, -1.1, 0.186), (0.002, -0.001, 0.003)),
    filter=AlphaBeta(0.1, 1e-4, DT),
    surface=18_000.0,
    error_weight=1.0,
    control_weight=100.0,
)
ONE = {  # controller, tuned parameter, stage
    "any order, anti-windup": (to_data(THIRD), "controller.law.anti_windup", "p753"),
    "pole placement": ("p753_pole_placement", "controller.law.poles.0", "p753"),
    "inverse Preisach": (
        "p753_preisach_inversion",
        "controller.feedback.law.integral",
        "p753_preisach",
    ),
    "phase compensation": ("p753_phase_compensator", "controller.share", "p753"),
    "preview": ("p753_preview_feedforward_pid", PID, "p753"),
    "iterative learning": ("p753_iterative_learning", "controller.gain", "p753"),
    "H-infinity": (
        "p753_feedforward_h_infinity",
        "controller.feedback.controller.effort_weight",
        "p753",
    ),
    "charge drive": ("p753_pid", "controller.integral", "p753_charge_driven"),
}
AXES = {
    "allocation": ("p558_pid", "controller.Z.integral", "p558_four_actuators", 500.0),
    "state estimation": (
        "p558_state_sliding_mode",
        "controller.process",
        "p558",
        500.0,
    ),
    "mirror of 24 states": (
        "mirror_state_sliding_mode",
        "controller.controller.drift",
        "mirror_24_states",
        6_400.0,
    ),
}


def case(tmp_path, controller, path, plant, rate, axes=None):
    """Read a study of these names from a file."""
    named = isinstance(controller, str)
    names = tuple(axes or ())
    tree = {
        "title": "reachable",
        "rate": rate,
        "plant": {"catalog": plant},
        "actuator": {"lower": -20.0, "upper": 120.0},
        "controller": {"catalog": controller} if named else controller,
        "references": {
            "tune": [f"{names[0]}:SIN10" if names else "SIN10"],
            "amplitude": 1.0,
            "duration": 0.3,
            "settle": 0.1,
        },
        "parameters": {path: {}},
    }
    if axes:
        tree["axes"] = {"names": list(names), "units": list(axes.values())}
        tree["references"]["offset"] = [20.0, 0.0, 0.0]
    (tmp_path / "study.toml").write_text(tomli_w.dumps(tree))
    return read(tmp_path / "study.toml")


@pytest.mark.parametrize("name", ONE)
def test_a_study_of_one_axis_names_the_scheme(name, tmp_path):
    controller, path, plant = ONE[name]
    found = case(tmp_path, controller, path, plant, p753.RATE)
    assert found.space.paths == (path,)
    assert get(found.loop, path).shape == ()


@pytest.mark.parametrize("name", AXES)
def test_a_study_of_three_axes_names_the_scheme(name, tmp_path):
    *names, rate = AXES[name]
    units = ("um", "um", "um") if "mirror" in name else ("um", "urad", "urad")
    found = case(
        tmp_path, *names, rate, dict(zip(("Z", "Rx", "Ry"), units, strict=True))
    )
    assert found.space.paths == (names[1],)


def test_a_charge_driven_stage_of_a_study_has_its_drive(tmp_path):
    controller, path, plant = ONE["charge drive"]
    found = case(tmp_path, controller, path, plant, p753.RATE).loop
    time = p753_survey.CHARGE_TIME
    assert float(get(found, "plant.drive.load_time")) == time
