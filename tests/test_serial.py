"""Systems as files: saved Systems are loaded, and other content is refused."""

import inspect
import json
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import piezojax as pj
from piezojax.catalog import CONTROLLERS, PLANTS, p753
from piezojax.core.feedback import Observation
from piezojax.core.serial import from_data, load, read_about, save, to_data

SCALAR = {
    "affine": pj.core.system.Affine(2.0, -0.5),
    "arma": pj.dynamics.ARMA((1.6035, -0.61995), (0.0050811, -0.0036354, 0.010553)),
    "delay": pj.core.system.Delay(3),
    "no delay": pj.core.system.Delay(0),
    "lag": pj.dynamics.FirstOrderLag(2.5e-3, 5e-5),
    "restoring force": pj.hysteresis.BoucWen(5e4, 800.0, -1100.0, 1.2, substeps=3),
    "oscillator": pj.hysteresis.HystereticOscillator(
        2.0, 10.0, 5e4, pj.hysteresis.BoucWen(5e4, 800.0, -1100.0), 1e-3
    ),
    "neural state space": pj.dynamics.NeuralStateSpace(
        state_matrix=[[0.8, 0.1], [-0.2, 0.5]],
        input_matrix=[[1.0], [0.3]],
        output_matrix=[[1.0, -2.0]],
        neuron_output=[[0.1, 0.2, -0.1], [0.0, 0.3, 0.1]],
        neuron_state=[[1.0, 0.5], [-0.3, 0.7], [0.2, 0.2]],
        neuron_input=[[0.5], [1.0], [-0.4]],
        neuron_bias=[0.1, -0.2, 0.0],
        input_offset=[0.3],
        output_offset=[-1.0],
    ),
    "saturation": pj.hardware.Saturation(-20.0, 120.0),
    "slew limit": pj.hardware.SlewLimit(1e4, 5e-5),
    "quantiser": pj.hardware.Quantiser(0.01),
    "hysteretic ARMA": pj.hysteresis.HystereticARMA(
        -0.03, (1.6, -0.6), (0.1, 0.2, 0.3), (1.0, 2.0, 3.0), 0.5, -2.0, "quadratic"
    ),
    "inverse": pj.hysteresis.InverseColemanHodgdon(p753.hysteresis()),
    "inverse of plays": pj.hysteresis.InversePrandtlIshlinskii(
        pj.hysteresis.PrandtlIshlinskii((0.1, 1e-4), (2.0, 5.0), (0.01, 0.02))
    ),
    "stops": pj.hysteresis.StopPrandtlIshlinskii(
        (0.1, 1e-4), (2.0, 5.0), (0.01, 0.02), 3.0
    ),
    "plays and their rate": pj.hysteresis.InverseRateDependentPrandtlIshlinskii(
        pj.hysteresis.RateDependentPrandtlIshlinskii(
            (0.1,), (2.0,), (0.01,), 1e-3, 5e-5
        )
    ),
    "learned": pj.hysteresis.LearnedOperator(
        (0.5,),
        (1.0, 0.2, 0.1),
        [[0.1, 0.2, 0.3]],
        (0.0,),
        (2.0,),
        (0.3,),
        5.0,
        2.0,
        1.0,
    ),
    "creep beside": pj.dynamics.LogarithmicCreep(0.01, 1.0, 10.0, 0.1, direct=0.0),
    "damped springs": pj.dynamics.SpringDamperCreep(
        (3.0,), (9.0,), float("inf"), 2.0, 0.1
    ),
    "drift": pj.dynamics.ThermalDrift(0.1, 30.0, 22.0, 0.1),
    "named series": pj.series(
        gain=pj.core.system.Affine(3.0), lag=pj.dynamics.FirstOrderLag(1e-3, 5e-5)
    ),
    "series": pj.core.system.Affine(3.0)
    >> pj.core.system.Delay(1)
    >> pj.hardware.Quantiser(0.1),
    "parallel": pj.core.system.Affine(3.0)
    + pj.core.system.Delay(2)
    + pj.dynamics.FirstOrderLag(1e-3, 5e-5),
    "nested": pj.series(
        sum=pj.core.system.Affine(1.0) + pj.core.system.Delay(1),
        out=pj.core.system.Affine(0.1),
    ),
} | {
    f"hysteresis, {scheme}": pj.hysteresis.ColemanHodgdon(
        **p753.HYSTERESIS_CHAPTER_5, rest_input=-3.0, rest_output=0.2, scheme=scheme
    )
    for scheme in ("trapezoid", "quadratic", "voros", "exact")
}
ONE_AXIS = [name for name in (*PLANTS, *CONTROLLERS) if name.startswith("p753")]
AXES = {
    name: make()
    for name, make in (PLANTS | CONTROLLERS).items()
    if name not in ONE_AXIS
}
PLANT = {name: PLANTS[name]() for name in PLANTS if name in ONE_AXIS}
CONTROLLER = {name: CONTROLLERS[name]() for name in CONTROLLERS if name in ONE_AXIS} | {
    "alpha-beta": pj.control.AlphaBeta(0.1, 1e-4, 5e-5),
    "kalman": p753.kalman(pj.dynamics.ARMA((0.9,), (0.1, 0.2))),
    "printed Q-filter": p753.disturbance_observer("5-4", coefficients="printed"),
}
RICH = pj.Feedback(
    p753.inversion(),
    p753.plant("exact"),
    pj.series(
        limits=p753.actuator(),
        slew=pj.hardware.SlewLimit(1e5, 5e-5),
        dac=pj.hardware.Quantiser(0.002),
    ),
    pj.series(noise=pj.hardware.Sensor(0.012), adc=pj.hardware.Quantiser(0.001)),
)
LOOP = {
    name: p753.loop(CONTROLLERS[name]()) for name in CONTROLLERS if name in ONE_AXIS
} | {"rich": RICH}
SENSOR = {
    "sensor": pj.hardware.Sensor(0.012),
    "recursive": pj.identification.RecursiveLeastSquares(
        -0.03, 0.99, 1e4, 0.0, 1, 2, "voros"
    ),
}


@pytest.fixture(params=["toml", "json"])
def there_and_back(request, tmp_path):
    def round_trip(system):
        path = tmp_path / f"system.{request.param}"
        save(system, path)
        return load(path)

    return round_trip


def assert_equal(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(
        jax.tree.leaves(found), jax.tree.leaves(expected), strict=True
    ):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def outputs(system, inputs):
    state, collected = system.init(inputs[0]), []
    for value in inputs:
        state, output = system.step(state, value)
        collected.append(output)
    return jax.tree.map(np.asarray, (state, collected))


@pytest.mark.parametrize("name", AXES)
def test_systems_of_several_axes(there_and_back, name):
    assert_equal(there_and_back(AXES[name]), AXES[name])


@pytest.mark.parametrize("name", SCALAR | PLANT)
def test_signal_systems(there_and_back, name):
    system = (SCALAR | PLANT)[name]
    back = there_and_back(system)
    assert type(back) is type(system)
    assert_equal(back, system)
    inputs = jnp.array([0.3, 1.0, -0.7, 2.5])
    assert_equal(outputs(back, inputs), outputs(system, inputs))


@pytest.mark.parametrize("name", CONTROLLER)
def test_controllers(there_and_back, name):
    system = CONTROLLER[name]
    back = there_and_back(system)
    assert_equal(back, system)
    rows = [(5.0, 5.1, 4.9, 30.0), (5.1, 5.3, 5.0, 30.5), (5.3, 5.6, 5.2, 31.0)]
    inputs = [Observation(*map(jnp.asarray, row)) for row in rows]
    assert_equal(outputs(back, inputs), outputs(system, inputs))


@pytest.mark.parametrize("name", LOOP | SENSOR)
def test_loops_and_sensors(there_and_back, name):
    system = (LOOP | SENSOR)[name]
    assert_equal(there_and_back(system), system)


def test_a_loaded_loop_runs_the_same(there_and_back):
    reference = 5.0 - 5.0 * jnp.cos(jnp.linspace(0.0, 6.0, 200))
    noise = jnp.asarray(np.random.default_rng(0).standard_normal(200))
    inputs = pj.loop_inputs(reference, noise)
    back = there_and_back(RICH)
    assert_equal(
        pj.simulate(back, inputs, back.init(0.0)),
        pj.simulate(RICH, inputs, RICH.init(0.0)),
    )


NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=100, deadline=None)
@given(NUMBERS, NUMBERS)
def test_no_digit_is_lost_in_memory(gain, offset):
    data = to_data(pj.core.system.Affine(gain, offset))
    back = from_data(json.loads(json.dumps(data)))
    assert (float(back.gain), float(back.offset)) == (gain, offset)


@pytest.mark.parametrize("value", [1e-300, 1 / 3, 1e22, -0.0, 5.0, 2.0**-1074])
def test_no_digit_is_lost_in_a_file(there_and_back, value):
    back = float(there_and_back(pj.core.system.Affine(value)).gain)
    assert back.hex() == value.hex()


def test_the_file_is_plain_and_readable(tmp_path):
    save(pj.series(limits=pj.hardware.Saturation(-20.0, 120.0)), tmp_path / "a.json")
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "type": "Series",
        "parts": [{"type": "Saturation", "lower": -20.0, "upper": 120.0}],
        "names": ["limits"],
    }


def test_defaults_may_be_left_out():
    system = from_data({"type": "ColemanHodgdon", "a": 0.01, "b": 0.1, "c": -0.05})
    assert system.scheme == "trapezoid"
    assert system.rest_input == 0.0


def test_saving_replaces_an_older_file(tmp_path):
    path = tmp_path / "a.toml"
    save(CONTROLLER["p753_inversion"], path)
    save(pj.core.system.Affine(2.0), path)
    assert_equal(load(path), pj.core.system.Affine(2.0))
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.toml"]


def test_every_exported_system_can_be_saved():
    kinds = re.search("one of (.*)", message_for({})).group(1).split(", ")
    for package in (pj.control, pj.dynamics, pj.hardware, pj.hysteresis):
        for name, thing in vars(package).items():
            if isinstance(thing, type) and issubclass(thing, pj.System):
                assert (name in kinds) != inspect.isabstract(thing), name


def message_for(data):
    with pytest.raises(ValueError, match=r".") as caught:
        from_data(data)
    assert "\n" not in str(caught.value)
    return str(caught.value)


EXECUTABLE = [
    "simulate",
    "tune",
    "load",
    "save",
    "os.system",
    "os",
    "eval",
    "__import__",
    "piezojax.core.system.Affine",
    "jax",
    "System",
    "Metric",
    "Tracking",
    "Record",
    "catalog",
    "",
    "affine",
]


@pytest.mark.parametrize("kind", EXECUTABLE)
def test_only_systems_are_constructed(kind):
    message = message_for({"type": kind})
    assert message.startswith(f"system.type is {kind!r}; it must be one of ARMA, Act")


@pytest.mark.parametrize("kind", [3, None, True])
def test_type_must_be_a_name(kind):
    message = message_for({"type": kind})
    assert message.startswith(f"system.type is {kind!r}; it must be one of ARMA, Act")


def test_no_type():
    message = message_for({"gain": 2.0})
    assert message.startswith(
        "system needs a key 'type' with one of ARMA, ActiveDamping, AdaptiveI"
    )


def test_unknown_key():
    assert message_for({"type": "Affine", "gian": 2.0}) == (
        "system.gian is unknown; Affine has gain, offset"
    )


@pytest.mark.parametrize("key", ["_kinds", "__class__", "init", "step"])
def test_methods_and_private_names_are_not_keys(key):
    assert message_for({"type": "Affine", key: 1.0}).startswith(
        f"system.{key} is unknown"
    )


def test_missing_key():
    message = message_for({"type": "Saturation", "lower": 0.0})
    assert message == "system.upper is missing"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            {"type": "Saturation", "lower": 3.0, "upper": 2.0},
            "system: lower is 3 and upper is 2; lower must be below upper",
        ),
        (
            {"type": "FirstOrderLag", "time_constant": -1.0, "dt": 1e-3},
            "system: time_constant in s is -1; it must be finite and above 0",
        ),
        (
            {"type": "Quantiser", "resolution": 0.0},
            "system: resolution in [input] is 0; it must be finite and above 0",
        ),
        (
            {"type": "ColemanHodgdon", "a": 1.0, "b": 1.0, "c": 1.0},
            "system: c in 1/V is 1; it must be finite and below 0",
        ),
        (
            {
                "type": "ColemanHodgdon",
                "a": 1.0,
                "b": 1.0,
                "c": -1.0,
                "scheme": "euler",
            },
            "system: scheme 'euler'; it must be one of ['trapezoid', 'quadratic', ",
        ),
        (
            {"type": "ARMA", "autoregressive": [0.5], "moving": []},
            "system: moving is empty; it must hold at least b_0",
        ),
        (
            {"type": "Affine", "gain": "two"},
            "system.gain is 'two'; it must be a number",
        ),
        (
            {"type": "Series", "parts": [{"type": "Affine"}], "names": ["a", "b"]},
            "system: 1 parts but names ('a', 'b')",
        ),
    ],
)
def test_bad_values(data, message):
    assert message_for(data).startswith(message)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"type": "Delay", "samples": -1}, "system.parts.1: samples is -1"),
        ({"type": "Dealy", "samples": 1}, "system.parts.1.type is 'Dealy'; it must"),
        ({"type": "Delay", "smaples": 1}, "system.parts.1.smaples is unknown; Delay"),
        ({"samples": 1}, "system.parts.1 needs a key 'type' with one of ARMA"),
    ],
)
def test_messages_name_the_nested_table(part, message):
    data = {"type": "Series", "parts": [{"type": "Affine"}, part]}
    assert message_for(data).startswith(message)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.toml", b"gain = = 2", "a.toml is not a TOML file"),
        ("a.json", b'{"type": ', "a.json is not a JSON file"),
        ("a.json", b"", "a.json is not a JSON file"),
        ("a.json", bytes(range(256)), "a.json is not a JSON file"),
        ("a.toml", bytes(range(128, 256)), "a.toml is not a TOML file"),
        ("a.toml", b"", "a.toml needs a key 'type'"),
        ("a.toml", b'type = "Affine"\ngian = 2.0', "a.toml.gian is unknown"),
    ],
)
def test_bad_files(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        load(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_missing_files(tmp_path):
    with pytest.raises(ValueError, match=r"no.json: No such file or directory"):
        load(tmp_path / "no.json")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(ValueError, match=r"folder.toml: Is a directory"):
        load(tmp_path / "folder.toml")


@pytest.mark.parametrize("name", ["a.yaml", "a", "a.toml.bak", "a.pkl"])
def test_other_formats(tmp_path, name):
    message = f"{name}: the name must end in .toml or .json"
    with pytest.raises(ValueError, match=re.escape(message)):
        save(pj.core.system.Affine(), tmp_path / name)
    with pytest.raises(ValueError, match=re.escape(message)):
        load(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    save(pj.core.system.Affine(2.0), path)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("piezojax.core.files.os.replace", full)
    with pytest.raises(OSError, match="No space left"):
        save(pj.core.system.Affine(3.0), path)
    monkeypatch.undo()
    assert load(path).gain == 2.0


ALARMS = ["Ms 3.1 is above its limit 2", "SW30 stays at a voltage limit"]


@pytest.mark.parametrize("name", ["a.toml", "a.json"])
def test_a_file_contains_the_origin_of_its_system(tmp_path, name):
    about = pj.About(study="mine", seed=3, rate_Hz=2e4, units={"command": "V"})
    save(pj.core.system.Affine(2.0), tmp_path / name, about)
    assert load(tmp_path / name) == pj.core.system.Affine(2.0)
    assert read_about(tmp_path / name) == about
    assert about.piezojax == pj.__version__
    save(pj.core.system.Affine(2.0), tmp_path / name)
    assert read_about(tmp_path / name) == pj.About(piezojax="unknown")


@pytest.mark.parametrize(
    ("alarms", "message"),
    [
        (ALARMS[:1], "a.toml was written with an alarm: Ms 3.1 is above its limit 2; "),
        (ALARMS, "a.toml was written with 2 alarms: Ms 3.1 is above its limit 2; SW30"),
    ],
)
def test_an_unsafe_file_is_refused(tmp_path, alarms, message):
    save(pj.core.system.Affine(2.0), tmp_path / "a.toml", pj.About(unsafe=alarms))
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        load(tmp_path / "a.toml")
    assert str(caught.value).endswith("pass accept_unsafe=True to load it anyway")
    assert load(tmp_path / "a.toml", accept_unsafe=True) == pj.core.system.Affine(2.0)


@pytest.mark.parametrize(
    ("about", "message"),
    [
        ('about = "me"', "a.toml: about is 'me'; it must be a table"),
        ('about.unsafe = "railed"', "a.toml: about.unsafe: Input should be a valid"),
    ],
)
def test_a_damaged_origin_is_refused(tmp_path, about, message):
    (tmp_path / "a.toml").write_text(f'type = "Affine"\n{about}\n')
    for read in (load, read_about):
        with pytest.raises(ValueError, match=re.escape(message)) as caught:
            read(tmp_path / "a.toml")
        assert "\n" not in str(caught.value)


# The tests check every type; a run of a user does not. Files with wrong types are
# therefore tested in a separate process.
ALPHA_BETA = {"type": "AlphaBeta", "alpha": 0.1, "beta": 0.1, "dt": 1e-4}
SLIDING_MODE = {
    "type": "SlidingMode",
    "law": {"type": "BangBang", "gain": 1.0},
    **dict.fromkeys(("surface", "error_weight", "control_weight"), 1.0),
}
WRONG_TYPES = {
    "a number for a system": {"type": "InverseColemanHodgdon", "model": 3},
    "another system": {"type": "InverseColemanHodgdon", "model": {"type": "Affine"}},
    "another model": SLIDING_MODE | {"model": {"type": "Affine"}, "filter": ALPHA_BETA},
    "numbers for parts": {"type": "Series", "parts": [1, 2]},
    "text for parts": {"type": "Series", "parts": "abc"},
    "half a sample": {"type": "Delay", "samples": 1.5},
    "text for samples": {"type": "Delay", "samples": "one"},
    "a list for a number": {"type": "Affine", "gain": [1.0, 2.0]},
    "nothing": {"type": "Affine", "gain": None},
    "not a number": {"type": "Affine", "gain": float("nan")},
    "a list for a type": {"type": ["Affine"]},
    "a number for coefficients": {"type": "ARMA", "autoregressive": 1, "moving": [1]},
    "a missing key": {"type": "Saturation", "lower": 0.0},
    "a list for the whole": [1],
}

SCRIPT = """
import json, sys
from piezojax.core.serial import from_data
for data in json.load(sys.stdin):
    try:
        print(json.dumps(["built", repr(from_data(data))]))
    except Exception as error:
        print(json.dumps([type(error).__name__, str(error)]))
"""


@pytest.fixture(scope="module")
def outcomes():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        input=json.dumps(list(WRONG_TYPES.values())),
        capture_output=True,
        text=True,
        check=True,
    )
    lines = map(json.loads, done.stdout.splitlines())
    return dict(zip(WRONG_TYPES, lines, strict=True))


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("a number for a system", "model"),
        ("another system", "model"),
        ("another model", "model"),
        ("numbers for parts", "parts"),
        ("text for parts", "parts"),
        ("half a sample", "samples"),
        ("text for samples", "samples"),
        ("a list for a number", "gain"),
        ("nothing", "gain"),
        ("not a number", "gain"),
        ("a list for a type", "system.type"),
        ("a number for coefficients", "autoregressive"),
        ("a missing key", "upper"),
        ("a list for the whole", "type"),
    ],
)
def test_wrong_types_without_type_checks(outcomes, name, key):
    kind, message = outcomes[name]
    assert kind == "ValueError"
    assert "\n" not in message
    assert key in message


NESTED = {
    "open.json": "[" * 100_000,
    "lists.json": "[" * 900 + "]" * 900,
    "lists.toml": "gain = " + "[" * 5000 + "]" * 5000,
    "tables.toml": f"[{'.'.join(['a'] * 5000)}]\nb = 1",
    "inline.toml": "a = " + "{ a = " * 200 + "1" + " }" * 200,
}


@pytest.mark.parametrize("name", NESTED)
def test_a_file_nested_too_deep(tmp_path, name):
    (tmp_path / name).write_text(NESTED[name], encoding="utf-8")
    message = rf"{name} nests tables or lists more than 64 deep$"
    with pytest.raises(ValueError, match=message):
        load(tmp_path / name)


def test_systems_nested_as_deep_as_allowed(tmp_path):
    data = {"type": "Affine", "gain": 2.0}
    for _ in range(31):  # a table and a list each
        data = {"type": "Series", "parts": [data]}
    (tmp_path / "a.json").write_text(json.dumps(data))
    assert float(pj.core.paths.get(load(tmp_path / "a.json"), "0." * 31 + "gain")) == 2


@pytest.mark.parametrize("digits", [309, 400, 5000])
@pytest.mark.parametrize("form", ['{{"type": "Affine", "gain": {}}}', "[{}]"])
def test_an_integer_too_large_for_a_float(tmp_path, digits, form):
    (tmp_path / "a.json").write_text(form.format("9" * digits))
    with pytest.raises(ValueError, match=r"a\.json") as caught:
        load(tmp_path / "a.json")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 250


def test_an_integer_of_more_than_64_bits_is_a_number(tmp_path):
    (tmp_path / "a.json").write_text('{"type": "Affine", "gain": 1' + "0" * 30 + "}")
    assert float(load(tmp_path / "a.json").gain) == 1e30


def test_saving_into_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere.a.json: No such file"):
        save(pj.core.system.Affine(), tmp_path / "nowhere" / "a.json")


@pytest.mark.parametrize("key", ["gain\n", "a\x1bb"])
def test_a_key_with_control_characters_is_refused_in_one_line(tmp_path, key):
    (tmp_path / "a.json").write_text(json.dumps({"type": "Affine", key: 1.0}))
    with pytest.raises(ValueError, match="which holds control characters") as caught:
        load(tmp_path / "a.json")
    assert str(caught.value).isprintable()
