"""Structures of a study: the criterion, the modes, the notches and the search."""

import copy
import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import tomli_w
from scipy import signal

import piezojax as pj
from piezojax.control import FilteredCommand
from piezojax.core.error_bound import ErrorBound
from piezojax.core.paths import get, get_part
from piezojax.core.progress import Silent
from piezojax.core.recipe import Resonance
from piezojax.dynamics import Modes
from piezojax.dynamics.plant_modes import plant_modes
from piezojax.report.structure_pictures import structures_figure, structures_table
from piezojax.study import Study, build
from piezojax.study.with_notches import with_notches
from piezojax.tuning import structure_figures
from piezojax.tuning import structure_search as searching
from piezojax.tuning.result import Result
from piezojax.tuning.structure_choice import (
    ModeInLoop,
    Structure,
    choose,
    explain,
    gain_of,
    is_worth,
)
from piezojax.tuning.structure_search import search_structures

DT = 1e-4
FIRST, SECOND, HIDDEN = (400.0, 0.01), (900.0, 0.008), (1600.0, 0.01)
MODES = {
    "type": "Modes",
    "frequency": [3000.0, FIRST[0], SECOND[0], HIDDEN[0]],
    "damping": [0.7, FIRST[1], SECOND[1], HIDDEN[1]],
    "share": [0.2, -0.1, 1e-5],
    "dt": DT,
}
STUDY = {
    "title": "a PI with notches",
    "rate": 1.0 / DT,
    "plant": {"type": "Series", "parts": [{"type": "Affine", "gain": 0.1}, MODES]},
    "actuator": {"lower": -100.0, "upper": 100.0},
    "sensor": {"noise_rms": 0.001},
    "controller": {"type": "PID", "proportional": 0.01, "integral": 100.0, "dt": DT},
    "references": {
        "tune": ["SIN20"],
        "unseen": ["SIN50"],
        "amplitude": 2.0,
        "duration": 0.06,
        "settle": 0.02,
    },
    "parameters": {
        "controller.integral": {"lower": 10.0, "upper": 1e5, "scale": "log"}
    },
    "constraints": {"sensitivity_peak": "off", "delay_margin": "off"},
    "optimiser": {"starts": 1, "candidates": 2, "steps": 3},
    "structures": {"notches": [0, 1, 2, 3]},
}


def data_with(**changes):
    data = copy.deepcopy(STUDY) | changes
    return {key: value for key, value in data.items() if value is not None}


def case_of(**changes):
    return build(Study.model_validate(data_with(**changes)), "small.toml")


def row(notches, errors, **more):
    """Return a structure with these errors (um) on the plants of the hold-out."""
    known = [error for error in errors if error is not None]
    return Structure(
        notches=notches,
        at_Hz=[100.0 * (i + 1) for i in range(notches)],
        gains={"controller.integral": 1.0},
        error_um=float(np.median(known)) if len(known) == len(errors) else None,
        log_errors=[None if e is None else math.log(e) for e in errors],
        modes=[
            ModeInLoop(
                frequency_Hz=100.0 * (i + 1),
                damping=0.01,
                part_of_loop_gain=0.5,
                notch=0.1,
            )
            for i in range(notches)
        ],
        **more,
    )


def plants(level, spread=0.02, count=8):
    """Return errors (um) around ``level``, other ones at each call."""
    random = np.random.default_rng(round(1e6 * level))
    return list(level * np.exp(spread * random.standard_normal(count)))


# The criterion


@pytest.mark.parametrize(
    ("levels", "notches"),
    [
        ([1.0, 0.97, 0.96, 0.95], 0),  # no notch gains a tenth
        ([1.0, 0.3, 0.29, 0.285], 1),
        ([1.0, 0.99, 0.3, 0.29], 2),  # two equal modes: one notch alone gains nothing
        ([1.0, 0.6, 0.3, 0.1], 3),
        ([1.0, 1.2, 1.5, 0.74], 0),  # three notches must gain 27 %
        ([1.0, 1.2, 1.5, 0.71], 3),
    ],
)
def test_the_fewest_notches_that_are_worth_their_parameters(levels, notches):
    rows = [row(n, [level] * 4) for n, level in enumerate(levels)]
    assert choose(rows, 0.1) == notches


def test_a_gain_within_two_standard_errors_does_not_count():
    smaller = row(0, [1.0, 1.0, 1.0, 1.0])
    # ln ratios 0.6, 0, 0.6, 0: mean 0.3, standard error 0.3464/2 = 0.173.
    unsure = row(1, [math.exp(-0.6), 1.0, math.exp(-0.6), 1.0])
    gain = gain_of(smaller, unsure)
    assert gain.mean == pytest.approx(0.3)
    assert gain.standard_error == pytest.approx(0.6 / math.sqrt(12.0))
    assert not is_worth(smaller, unsure, 0.1)
    sure = row(1, [math.exp(-0.4), math.exp(-0.2), math.exp(-0.4), math.exp(-0.2)])
    assert gain_of(smaller, sure).mean == pytest.approx(0.3)
    assert is_worth(smaller, sure, 0.1)
    assert not is_worth(smaller, sure, 0.27)  # exp(-0.3) is 0.741


def test_plants_are_compared_in_pairs():
    """A gain of 15 % counts although the plants differ by a factor of ten."""
    errors = list(np.geomspace(0.1, 1.0, 8))
    assert choose([row(0, errors), row(1, [0.85 * e for e in errors])], 0.1) == 1
    # Shuffled, the same errors are a gain on some plants and a loss on others.
    shuffled = [0.85 * e for e in errors[::-1]]
    assert choose([row(0, errors), row(1, shuffled)], 0.1) == 0


def test_alarms_lost_runs_and_idle_notches_come_before_errors():
    none, one, two = (row(n, plants(e)) for n, e in enumerate((1.0, 0.3, 0.1)))
    assert choose([none, one, two], 0.1) == 2
    alarmed = two.model_copy(update={"alarms": 1})
    assert choose([none, one, alarmed], 0.1) == 1
    assert choose([r.model_copy(update={"alarms": 1}) for r in (none, one)], 0.1) == 1
    lost = row(2, [*plants(0.1, count=7), None])
    assert choose([none, one, lost], 0.1) == 1
    assert choose([row(0, [None, 1.0])], 0.1) == 0  # with its alarm
    far = [mode.model_copy(update={"notch": 0.9}) for mode in two.modes]
    idle = two.model_copy(update={"modes": [two.modes[0], far[1]]})
    assert idle.idle == [200.0]
    rows = [none, one, idle, lost]
    assert choose(rows, 0.1) == 1
    explain(rows, 1)
    assert [r.chosen for r in rows] == [False, True, False, False]
    assert rows[0].reason.endswith("times the error of the chosen one")
    assert rows[2].reason == "no notch acts on the mode at 200 Hz"
    assert (
        rows[3].reason
        == "the loop is unstable, or a run diverges or stays at a voltage limit"
    )
    assert choose([Structure(notches=1, at_Hz=[], reason="not tuned")], 0.1) is None


def test_a_structure_that_is_too_large_says_by_how_much():
    rows = [row(0, [1.0] * 4), row(2, [0.9] * 4)]
    explain(rows, choose(rows, 0.1))
    assert rows[1].reason == (
        "0.9 times the error of the chosen one (standard error 0): not worth 2 more"
    )


# Modes and notches


def test_modes_of_a_plant_are_those_it_is_made_of():
    case = case_of()
    found = plant_modes(case.loop.plant, 1.0, DT)
    expected = [FIRST, SECOND, HIDDEN]
    np.testing.assert_allclose([m[:2] for m in found], expected, rtol=1e-9)
    # At resonance a mode alone has the gain share / (2 damping sqrt(1 - damping^2)).
    gains = [0.1 * s / (2.0 * z) for s, z in ((0.2, 0.01), (0.1, 0.008), (1e-5, 0.01))]
    held = np.sinc(DT * np.array([f for f, _ in expected]))
    np.testing.assert_allclose([m.gain for m in found], gains * held, rtol=0.02)
    assert found[0].share == pytest.approx(1.0, abs=0.15)
    assert found[2].share < 2e-3


def test_a_well_damped_mode_is_none_and_neither_is_one_at_nyquist():
    plant = Modes((400.0, 4700.0, 800.0), (0.25, 0.01, 0.19), DT, (0.2, 0.2))
    (only,) = plant_modes(plant, 0.0, DT)
    assert only.frequency == pytest.approx(800.0)


def test_gain_of_a_notch_is_that_of_its_discrete_filter():
    frequency, damping, depth, angle = 700.0, 0.3, 0.1, 0.5
    w = 2.0 / DT * math.tan(math.pi * frequency * DT)
    zeros = [1.0, 2.0 * depth * damping * w, w**2]
    b, a = signal.bilinear(zeros, [1.0, 2.0 * damping * w, w**2], 1.0 / DT)
    _, response = signal.freqz(b, a, [angle])
    found = structure_figures._notch_gain(frequency, damping, depth, angle, DT)
    assert found == pytest.approx(abs(response[0]), rel=1e-12)


def test_notches_that_are_off_leave_the_loop_as_it_is():
    case = case_of()
    variant = with_notches(case, [Resonance(*FIRST), Resonance(*SECOND)])
    assert variant.space.paths[0] == "controller.controller.integral"
    assert len(variant.space.paths) == 7
    assert variant.study.structures is None
    assert variant.study.optimiser.starts == 3
    assert float(get(variant.loop, "controller.filter.notch_2.frequency")) == SECOND[0]
    reference = pj.signals.signal("SIN20", pj.signals.time_grid(0.05, 1.0 / DT))

    def error(loop):
        state = loop.init(reference[0])
        log = pj.simulate(loop, pj.loop_inputs(reference), state)[1]
        return np.asarray(log.displacement - log.reference)

    start = variant.space.put(variant.loop, variant.space.start(variant.loop))
    np.testing.assert_allclose(error(start), error(case.loop), rtol=1e-3, atol=1e-6)
    same = with_notches(case, [])
    assert same.loop is case.loop
    assert same.space is case.space


def test_notches_filter_the_feedback_alone():
    controller = {"catalog": "p753_feedforward_simc_pi"}
    path = "controller.feedback.integral"
    tuned = {path: {"lower": 1.0, "upper": 1e5, "scale": "log"}}
    case = case_of(
        rate=20_000.0,
        plant={"catalog": "p753"},
        controller=controller,
        parameters=tuned,
    )
    variant = with_notches(case, [Resonance(*FIRST)])
    assert isinstance(get_part(variant.loop, "controller.feedback"), FilteredCommand)
    assert variant.space.paths[0] == "controller.feedback.controller.integral"
    outside = {"notches": [0, 1], "behind": "controller"}
    moved = with_notches(
        case_of(
            rate=20_000.0,
            plant={"catalog": "p753"},
            controller=controller,
            parameters=tuned,
            structures=outside,
        ),
        [Resonance(*FIRST)],
    )
    assert isinstance(moved.loop.controller, FilteredCommand)


SERVO = {
    "type": "Servo",
    "proportional": 0.01,
    "integral": 10.0,
    "lower": -100.0,
    "upper": 100.0,
    "dt": DT,
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"notches": [1]}, "structures.notches: .*at least 2"),
        ({"notches": [1, 1]}, "structures.notches: 1 is listed twice"),
        ({"notches": [0, 5]}, "structures.notches.1 is 5: .*less than or equal to 4"),
        ({"notches": [0, 1], "worth": 1.0}, "structures.worth is 1.0: .*less than 1"),
        ({"notches": [0, 1], "where": 1}, "structures.where is unknown; allowed are"),
    ],
)
def test_bad_tables_in_one_line(changes, message, tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text(tomli_w.dumps(data_with(structures=changes)), encoding="utf-8")
    with pytest.raises(ValueError, match=message) as caught:
        pj.study.load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"structures": {"notches": [0, 1], "behind": "controller.feedback"}},
            "structures.behind: no part 'controller.feedback'; controller has propor",
        ),
        (
            {"structures": {"notches": [0, 1], "behind": "plant"}},
            "structures.behind: plant must begin with 'controller'",
        ),
        (
            {"structures": {"notches": [0, 1], "behind": "controller.integral"}},
            "behind: controller.integral is a .*; it must map an Observation to a comm",
        ),
        ({"controller": SERVO}, "structures: Servo has notches of its own"),
    ],
)
def test_bad_places_of_notches(changes, message):
    with pytest.raises(ValueError, match=message):
        pj.tune(case_of(**changes))


def test_structures_are_one_search_at_a_time():
    with pytest.raises(ValueError, match="structures and pareto are both given"):
        case_of(
            constraints={"sensitivity_peak": 1.8},
            pareto={"constraint": "sensitivity_peak", "limits": [1.5, 1.8]},
        )
    with pytest.raises(ValueError, match="baselines are for one structure"):
        pj.tune(case_of(), baselines=pj.tuning.baselines.Budget())


# The search, on tuning that is only pretended


DEPTH = 0.3
"""Depth of every notch that is pretended to be tuned."""


class Pretended:
    """Tuning that takes its errors and loop gains from tables, by notched modes.

    ``errors`` maps the tuple of notched frequencies to the error (um), ``parts`` to the
    part of |L| of each mode of the plant.
    """

    def __init__(self, errors, parts, status="converged"):
        self.errors, self.parts, self.status = errors, parts, status
        self.calls, self.starts = [], []

    def __call__(self, case, also, progress):
        at = notched(case.loop)
        self.calls.append(at)
        self.starts.append(also)
        if self.errors[at] is None:
            raise ValueError("the loop diverges everywhere")
        modes = plant_modes(case.loop.plant, 1.0, DT)
        parts = np.array(self.parts.get(at, [0.0] * 3))

        def response(angle):
            # The phase is such that |S| is 1 + part.
            nearest = np.argmin(np.abs([mode.angle - angle[16] for mode in modes]))
            size = parts[nearest] / modes[nearest].share
            wanted = (1.0 + parts[nearest]) ** -2 - 1.0 - size**2
            phase = np.arccos(np.clip(wanted / (2.0 * max(size, 1e-9)), -1.0, 1.0))
            return np.full(len(angle), size * np.exp(1j * phase))

        after = case.space.put(case.loop, case.space.start(case.loop))
        gains = {path: float(get(after, path)) for path in case.space.paths}
        for path in gains:
            if path.endswith("depth"):
                gains[path] = DEPTH
        result = SimpleNamespace(
            gains=gains,
            perturbed=None,
            holdout=SimpleNamespace(per_reference_rms_um={"a": self.errors[at]}),
            unseen=SimpleNamespace(per_reference_rms_um={"b": self.errors[at]}),
            alarms=[],
            warnings=[],
            status=self.status,
            evaluations=10,
            compile_s=1.0,
            wall_s=2.0,
            structures=None,
        )
        stability = SimpleNamespace(
            loops={"after": {"one": SimpleNamespace(response=response)}},
            reports={},
            axes={},
        )
        return SimpleNamespace(result=result, stability=stability, after=after)


def notched(loop):
    """Return the frequencies of the notches of a loop, Hz."""
    if not isinstance(loop.controller, FilteredCommand):
        return ()
    parts = loop.controller.filter.parts
    return tuple(round(float(notch.frequency)) for notch in parts)


def searched(tuning, **changes):
    return search_structures(case_of(**changes), tuning, Silent()).result


ALL = {
    (): [0.5, 0.3, 1e-4],
    (400,): [0.4, 0.6, 1e-3],
    (900,): [0.5, 0.4, 1e-4],
    (400, 900): [0.4, 0.4, 1e-3],
}


def test_each_notch_goes_where_the_tuned_loop_is_limited():
    tuning = Pretended({(): 1.0, (400,): 0.5, (400, 900): 0.1}, ALL)
    result = searched(tuning)
    assert tuning.calls == [(), (400,), (400, 900)]
    rows = result.structures.structures
    assert [r.chosen for r in rows] == [False, False, True, False]
    assert rows[2].at_Hz == pytest.approx([400.0, 900.0])
    assert rows[2].parameters == 7
    assert rows[3].reason.startswith("not tuned: of 3 modes of the plant, no other")
    assert rows[0].reason == "10 times the error of the chosen one"
    assert (result.evaluations, result.compile_s, result.wall_s) == (30, 3.0, 6.0)
    (note,) = result.warnings
    assert note.startswith("structures: the hold-out chose among 3 structures")
    assert "10 %" in result.structures.criterion
    table = structures_table(result.structures)
    assert table.row_count == 4
    assert structures_figure(result.structures, "small") is not None
    alone = result.structures.model_copy(update={"structures": rows[2:]})
    assert structures_figure(alone, "small") is None


def test_no_notch_where_no_mode_limits_the_loop():
    tuning = Pretended({(): 1.0}, {(): [0.09, 0.02, 1e-4]})
    rows = searched(tuning).structures.structures
    assert tuning.calls == [()]
    assert [r.chosen for r in rows] == [True, False, False, False]


def test_a_notch_that_the_loop_does_not_need_is_dropped():
    """The mode at 400 Hz limits the first loop, but nothing once 900 Hz has a notch."""
    errors = {(): 1.0, (400,): 0.8, (400, 900): 0.1, (900,): 0.101}
    parts = ALL | {(400, 900): [0.1, 0.4, 1e-3]}
    tuning = Pretended(errors, parts)
    rows = searched(tuning).structures.structures
    assert tuning.calls == [(), (400,), (400, 900), (900,)]
    assert [r.at_Hz for r in rows if r.chosen] == [pytest.approx([900.0])]
    # If the smaller structure cannot be tuned, the larger one stays.
    tuning = Pretended(errors | {(900,): None}, parts)
    rows = searched(tuning).structures.structures
    assert [r.chosen for r in rows] == [False, False, True, False, False]
    assert len(tuning.calls) == 4
    # With its notch needed, the other structure is not even tried.
    tuning = Pretended(errors, ALL)
    assert searched(tuning).structures.structures[2].chosen
    assert tuning.calls == [(), (400,), (400, 900)]


def test_a_notch_at_the_wrong_of_two_modes_is_moved():
    """The mode at 400 Hz limits nothing with its notch off; that at 900 Hz does."""
    errors = {(): 1.0, (400,): 0.5, (900,): 0.4}
    tuning = Pretended(errors, ALL | {(400,): [0.13, 0.5, 1e-4]})
    limits = {"sensitivity_peak": 1.8, "delay_margin": "off"}
    changes = {"structures": {"notches": [0, 1]}, "constraints": limits}
    rows = searched(tuning, **changes).structures.structures
    assert tuning.calls == [(), (400,), (900,)]
    assert [r.at_Hz for r in rows if r.chosen] == [pytest.approx([900.0])]
    # There is no third mode that limits the loop.
    tuning = Pretended(errors, {(): [0.5, 0.05, 1e-4], (400,): [0.13, 0.05, 1e-4]})
    searched(tuning, **changes)
    assert tuning.calls == [(), (400,)]
    # If the other structure cannot be tuned, the search goes on.
    tuning = Pretended(errors | {(900,): None}, ALL | {(400,): [0.13, 0.5, 1e-4]})
    rows = searched(tuning, **changes).structures.structures
    assert [r.chosen for r in rows] == [True, False, False]


@pytest.mark.parametrize(
    ("limit", "part", "needed"),
    [  # with its notch of depth 0.3 off, the mode makes part/0.3 of |L|
        ("off", 0.29, False),
        ("off", 0.31, True),  # could make the loop unstable: 1.03
        (1.8, 0.13, False),
        (1.8, 0.14, True),  # 0.467, and |1 + L| of 1/1.8 is 0.444 from 1
    ],
)
def test_a_notch_at_a_mode_that_cannot_limit_the_loop_is_not_chosen(
    limit, part, needed
):
    """The notch halves the error all the same, by its phase."""
    alone = {(): [0.5, 0.05, 1e-4], (400,): [part, 0.05, 1e-4]}
    tuning = Pretended({(): 1.0, (400,): 0.5}, alone)
    result = searched(
        tuning,
        structures={"notches": [0, 1]},
        constraints={"sensitivity_peak": limit, "delay_margin": "off"},
    )
    rows = result.structures.structures
    assert [r.chosen for r in rows] == [not needed, needed]
    if not needed:
        assert rows[1].reason == "the mode at 400 Hz is too small to limit the loop"


def test_the_search_goes_on_from_the_gains_before():
    tuning = Pretended({(): 1.0, (400,): 0.5, (400, 900): 0.1}, ALL)
    searched(tuning)
    none, one, two = tuning.starts
    assert none is None
    # Each start once: these searches return the gains of the study.
    assert one.shape == (2, 4)
    assert two.shape == (4, 7)
    # The second notch is on in every start, the first as it was tuned in two of them.
    first, second = two[:, 3], two[:, 6]
    np.testing.assert_allclose(second, [0.05, 0.05] * 2, rtol=1e-6)
    np.testing.assert_allclose(np.sort(first)[2:], DEPTH, rtol=1e-6)
    assert np.all(np.sort(first)[:2] < DEPTH)


def test_a_mode_below_the_error_bound_of_the_model_may_be_noise():
    """The third mode makes 0.05 % of the response, the bound is 1 %, then 200 %."""
    case = case_of()
    modes, notes = searching._shown_modes(case)
    assert (len(modes), notes) == (3, [])

    def bounded(relative):
        bound = ErrorBound(
            frequency=(0.0, 5000.0), relative=(relative,) * 2, excited=(True,) * 2
        )
        return dataclasses.replace(case, plant_about=pj.About(error_bound=bound))

    shown, (note,) = searching._shown_modes(bounded(0.01))
    assert [mode.frequency for mode in shown] == pytest.approx([400.0, 900.0])
    assert "no notch is tried at 1600 Hz" in note
    assert searching._shown_modes(bounded(2.0))[0] == []


def test_structures_that_cannot_be_tuned_are_rows():
    tuning = Pretended({(): None, (400,): 0.5, (400, 900): 0.47}, ALL)
    rows = searched(tuning).structures.structures
    assert rows[0].reason == "the loop diverges everywhere"
    assert rows[1].chosen
    hopeless = Pretended(dict.fromkeys([(), (400,), (400, 900), (400, 900, 1600)]), ALL)
    with pytest.raises(ValueError, match=r"^the loop diverges everywhere$"):
        searched(hopeless)


def test_an_interrupt_keeps_the_best_structure_so_far():
    tuning = Pretended({(): 1.0}, ALL, status="interrupted")
    result = searched(tuning)
    assert tuning.calls == [()]
    assert result.status == "interrupted"
    assert result.structures.structures[0].chosen


# One search from end to end


def test_structures_are_tuned_and_their_table_is_written():
    optimiser = {"method": "bfgs", "starts": 1, "candidates": 1, "steps": 1}
    case = case_of(structures={"notches": [0, 1]}, optimiser=optimiser)
    outcome = pj.tune(case)
    result = Result.model_validate_json(outcome.result.model_dump_json())
    rows = result.structures.structures
    assert [r.notches for r in rows] == [0, 1]
    (chosen,) = (r for r in rows if r.chosen)
    assert chosen.gains == result.gains
    assert [r.parameters for r in rows] == [1, 4]
    assert all(r.error_um > 0.0 and len(r.log_errors) == 2 for r in rows)
    assert rows[1].notches_Hz[0] == pytest.approx(FIRST[0], rel=0.1)
    assert result.evaluations >= sum(len(r.log_errors) for r in rows)
    controller = outcome.controller
    assert isinstance(controller, FilteredCommand) == bool(chosen.notches)
    for path, value in chosen.gains.items():
        assert float(get(controller, path.removeprefix("controller."))) == value
