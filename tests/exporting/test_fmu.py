"""FMUs, validated and run by FMPy, a client that shares no code with piezojax."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import piezojax as pj
from piezojax.catalog import CONTROLLERS, PLANTS
from piezojax.core.serial import to_data
from piezojax.core.system import rest_output

fmpy = pytest.importorskip("fmpy")
pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None, reason="there is no C compiler"
)

RATE = 2e4
ABOUT = pj.About(
    rate_Hz=RATE,
    judged=["fine"],
    actuator=to_data(pj.Saturation(-20.0, 120.0)),
    reference_ranges=[(0.0, 10.0)],
)


class Unit:
    """An FMU as a function of one sample."""

    def __init__(self, path, folder, **start):
        from fmpy.fmi2 import FMU2Slave

        about = fmpy.read_model_description(path)
        self.numbers = {v.name: v.valueReference for v in about.modelVariables}
        self.outputs = [
            v.valueReference for v in about.modelVariables if v.causality == "output"
        ]
        self.fmu = FMU2Slave(
            guid=about.guid,
            modelIdentifier=about.coSimulation.modelIdentifier,
            unzipDirectory=fmpy.extract(path, folder),
        )
        self.fmu.instantiate()
        self.begin(**start)

    def begin(self, **start):
        self.set(**start)
        self.fmu.setupExperiment()
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        self.time = 0.0

    def set(self, **values):
        self.fmu.setReal([self.numbers[n] for n in values], list(values.values()))

    def step(self, count=1, **inputs):
        self.set(**inputs)
        self.fmu.doStep(self.time, count / RATE)
        self.time += count / RATE
        return self.fmu.getReal(self.outputs)


def exported(system, folder, **options):
    (path,) = pj.export(system, folder, to="fmu", about=ABOUT, **options)
    return str(path)


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fmu")
    return {
        "controller": exported(
            CONTROLLERS["p753_disturbance_observer"](), folder / "controller"
        ),
        "plant": exported(PLANTS["p753_stage"](), folder / "plant"),
    }


@pytest.mark.parametrize("kind", ["controller", "plant"])
def test_fmpy_has_nothing_to_say(paths, kind):
    from fmpy.validation import validate_fmu

    assert validate_fmu(paths[kind]) == []


def test_the_loop_of_two_fmus_equals_the_simulation(paths, tmp_path):
    loop = pj.Feedback(
        CONTROLLERS["p753_disturbance_observer"](),
        PLANTS["p753_stage"](),
        pj.Saturation(-20.0, 120.0),
        pj.Sensor(0.0),
    )
    time = np.arange(400) / RATE
    reference = 5.0 + np.where(time > 0.002, 3.0 * np.sin(2 * np.pi * 100 * time), 0.0)
    start = loop.init(reference[0])
    _, log = pj.simulate(loop, pj.loop_inputs(jnp.asarray(reference)), start)
    held, rest = float(start.voltage), float(start.displacement)
    plant = Unit(paths["plant"], str(tmp_path / "plant"), input=held)
    controller = Unit(
        paths["controller"],
        str(tmp_path / "controller"),
        reference=reference[0],
        next_reference=reference[0],
        measured=rest,
        start_applied=held,
    )
    following, y, found = np.append(reference[1:], reference[-1]), rest, []
    for now, later in zip(reference, following, strict=True):
        found.append(y)
        (u,) = controller.step(reference=now, next_reference=later, measured=y)
        (y,) = plant.step(input=u)
    assert np.ptp(found) > 5.0
    np.testing.assert_allclose(found, log.displacement, rtol=0, atol=1e-9)


def test_the_outputs_before_the_first_step_are_those_at_rest(paths, tmp_path):
    controller = Unit(
        paths["controller"],
        str(tmp_path / "controller"),
        **{"reference": 5.0, "next_reference": 5.0, "measured": 5.0},
        start_applied=37.5,
    )
    plant = Unit(paths["plant"], str(tmp_path / "plant"), input=37.5)
    rest = float(rest_output(PLANTS["p753_stage"](), 37.5))
    for unit, expected in ((controller, 37.5), (plant, rest)):
        for _ in range(2):
            found = unit.fmu.getReal(unit.outputs)
            assert found == [pytest.approx(expected, rel=1e-12)]
        assert unit.step() == [pytest.approx(expected, rel=1e-9)]
        unit.fmu.reset()
        assert unit.fmu.getReal(unit.outputs) == [0.0]
    plant.begin(input=20.0)
    expected = float(rest_output(PLANTS["p753_stage"](), 20.0))
    assert plant.fmu.getReal(plant.outputs) == [pytest.approx(expected, rel=1e-12)]


def test_every_output_is_that_at_rest(tmp_path):
    stage = PLANTS["mirror"]()
    unit = Unit(exported(stage, tmp_path / "x"), str(tmp_path / "unpacked"))
    inputs = [name for name in unit.numbers if name.startswith("input")]
    unit.fmu.reset()
    values = 1.0 + np.arange(len(inputs))
    unit.begin(**dict(zip(inputs, values, strict=True)))
    expected = jax.tree.leaves(rest_output(stage, tuple(map(jnp.asarray, values))))
    np.testing.assert_allclose(unit.fmu.getReal(unit.outputs), expected, rtol=1e-9)


def test_a_step_of_several_samples_holds_the_input(paths, tmp_path):
    units = [
        Unit(paths["plant"], str(tmp_path / name), input=20.0) for name in ("a", "b")
    ]
    together = units[0].step(5, input=50.0)
    apart = [units[1].step(input=50.0) for _ in range(5)][-1]
    assert together == apart


def test_a_parameter_outside_its_limits_and_part_of_a_sample_are_errors(
    tmp_path,
):
    path = exported(CONTROLLERS["p753_pid"](), tmp_path / "pid")
    unit = Unit(path, str(tmp_path / "unpacked"))
    unit.step()
    with pytest.raises(Exception, match="fmi2DoStep failed"):
        unit.step(0.5)
    unit.set(controller_anti_windup=-1.0)
    with pytest.raises(Exception, match="fmi2DoStep failed"):
        unit.step()
    with pytest.raises(Exception, match="fmi2SetReal failed"):
        unit.fmu.setReal(unit.outputs, [1.0])


def test_the_same_gains_give_the_same_sources(tmp_path):
    import zipfile

    def texts(folder):
        with zipfile.ZipFile(exported(CONTROLLERS["p753_pid"](), folder)) as archive:
            return {
                name: archive.read(name)
                for name in archive.namelist()
                if not name.startswith("binaries")
            }

    one, other = texts(tmp_path / "a"), texts(tmp_path / "b")
    assert one == other
    assert "modelDescription.xml" in one


@pytest.mark.parametrize(
    ("about", "options", "message"),
    [
        (ABOUT.model_copy(update={"rate_Hz": None}), {}, "needs the sampling rate"),
        (ABOUT, {"precision": "float"}, "the numbers of fmu are double"),
        (ABOUT, {"to": "exe"}, "to is 'exe': choose from c, fmu, mat, octave"),
    ],
)
def test_bad_options_are_refused(about, options, message, tmp_path):
    options = {"to": "fmu", "about": about} | options
    with pytest.raises(ValueError, match=message):
        pj.export(CONTROLLERS["p753_pid"](), tmp_path / "x", **options)
    assert not (tmp_path / "x").exists()


def test_without_a_compiler_there_is_no_fmu(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(ValueError, match=r"install a C compiler \(cc\)"):
        exported(CONTROLLERS["p753_pid"](), tmp_path / "x")
