"""Controllers and plants as C: compiled, run, and compared with the simulation."""

import itertools
import subprocess
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exported_folders import compiled, made
from golden import golden_vectors

import piezojax as pj
from piezojax.catalog import CONTROLLERS, PLANTS
from piezojax.core.axes import PerAxis
from piezojax.core.parameter import parameter
from piezojax.core.serial import to_data
from piezojax.core.system import System, series
from piezojax.exporting import Driven, Seen
from piezojax.exporting.prepared import prepared_nodes
from piezojax.exporting.products import shorten_products
from piezojax.hardware import Quantiser, SlewLimit
from piezojax.scalar import NotScalarError, trace
from piezojax.scalar.c_source import DOUBLE, statements
from piezojax.scalar.graph import CONSTANT, INPUT

ACTUATOR = to_data(pj.Saturation(-20.0, 120.0))
ABOUT = pj.About(
    study="a study",
    judged=["tuned loop: sensitivity peak 1.5"],
    plants=["gain +- 10 %", "mode_frequency 3600 to 4400"],
    seed=3,
    rate_Hz=2e4,
    actuator=ACTUATOR,
    reference_ranges=[(0.0, 10.0)],
)

# Compiled


@compiled
@pytest.mark.parametrize(
    ("name", "samples"),
    [
        ("p753_adaptive_pi", 2000),
        ("p753_bang_bang", 2000),
        ("p753_kalman_disturbance_observer", 2000),
        ("p753_repetitive", 4500),  # two periods and more: each is read and written
        ("p753_iterative_learning", 6500),  # three trials: both rows
    ],
)
def test_a_controller_equals_its_simulation(name, samples, tmp_path):
    pj.export(CONTROLLERS[name](), tmp_path / "c", about=ABOUT, samples=samples)
    status, text = made(tmp_path / "c")
    assert status == 0, text
    assert "passed" in text


class Equations(System):
    """A static map that solves triangular equations, from both sides."""

    matrix: jax.Array

    def init(self, input=0.0):
        return jnp.full(3, input)

    def step(self, state, input):
        state = jnp.stack([input, *state[:-1]])
        total = jnp.zeros(())
        for left, lower, transposed, unit in itertools.product((True, False), repeat=4):
            solved = jax.lax.linalg.triangular_solve(
                self.matrix,
                state[:, None] if left else state[None],
                left_side=left,
                lower=lower,
                transpose_a=transposed,
                unit_diagonal=unit,
            )
            total = total + solved.ravel() @ jnp.asarray([1.0, -2.0, 3.0])
        return state, total


@compiled
def test_triangular_equations_are_solved_in_every_step(tmp_path):
    matrix = np.array([[2.0, 0.3, -0.4], [0.5, 1.5, 0.2], [-0.3, 0.7, 1.2]])
    pj.export(Equations(jnp.asarray(matrix)), tmp_path / "c", about=ABOUT)
    status, text = made(tmp_path / "c")
    assert status == 0, text


@compiled
def test_a_linear_model_starts_at_rest_for_the_exported_parameters(tmp_path):
    A = 0.98 * np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])
    model = pj.dynamics.StateSpace(A, [[0.01], [0.02]], [[1.0, 0.5]], [[0.0]], 5e-5)
    pj.export(pj.core.axes.Packed(model), tmp_path / "c", about=ABOUT)
    status, text = made(tmp_path / "c")
    assert status == 0, text


def test_the_header_says_that_changed_parameters_leave_a_solved_start(tmp_path):
    model = pj.core.axes.Packed(
        pj.dynamics.StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 5e-5)
    )
    for system, said in ((model, True), (PLANTS["p753"](), False)):
        header, *_ = pj.export(system, tmp_path / f"{said}", about=ABOUT)
        assert ("does not begin at rest" in header.read_text()) == said


@compiled
def test_a_filter_that_amplifies_rounding_errors_has_a_wider_tolerance(tmp_path):
    about = pj.About(judged=["fine"], reference_ranges=[(-9.0, 9.0)] * 3)
    controller = CONTROLLERS["p558_disturbance_observer"]()
    limits = [(-50.0, 50.0)] * 3
    files = pj.export(controller, tmp_path / "c", about=about, limits=limits)
    status, text = made(tmp_path / "c")
    assert status == 0, text
    text = files[2].read_text().partition("worst[i] <= ")[2]
    assert 1e-12 < float(text.partition(" ")[0]) < 1e-10


@compiled
def test_a_controller_of_several_axes_equals_its_simulation(tmp_path):
    about = pj.About(judged=["fine"], reference_ranges=[(-9.0, 9.0)] * 3)
    limits = [(-50.0, 50.0), (-40.0, 40.0), (-30.0, 30.0)]
    files = pj.export(
        CONTROLLERS["p558_pid"](), tmp_path / "c", about=about, limits=limits
    )
    status, text = made(tmp_path / "c")
    assert status == 0, text
    assert text.count("passed") == 3
    assert "controller_output *output" in files[0].read_text()


@compiled
def test_the_actuator_of_the_study_leaves_with_the_controller(tmp_path):
    actuator = pj.series(
        limits=pj.Saturation(-20.0, 120.0),
        slew=pj.hardware.SlewLimit(1e4, 5e-5),
        converter=pj.hardware.Quantiser(0.25),
    )
    about = ABOUT.model_copy(update={"actuator": to_data(actuator)})
    pj.export(CONTROLLERS["p753_pid"](), tmp_path / "c", about=about)
    status, text = made(tmp_path / "c")
    assert status == 0, text
    rows = golden_vectors(tmp_path / "c")
    voltage = rows[:, -1]
    assert np.all(voltage % 0.25 == 0.0)
    assert np.abs(np.diff(voltage)).max() == 0.5  # V a sample


@compiled
def test_a_plant_equals_its_simulation(tmp_path):
    pj.export(PLANTS["p753_stage"](), tmp_path / "c")
    status, text = made(tmp_path / "c")
    assert status == 0, text


@compiled
def test_a_changed_sign_fails_the_test_of_the_export(tmp_path):
    _, source, *_ = pj.export(CONTROLLERS["p753_pid"](), tmp_path / "c", about=ABOUT)
    text = source.read_text()
    assert text.count("reference - measured") == 1
    source.write_text(text.replace("reference - measured", "reference + measured"))
    status, text = made(tmp_path / "c")
    assert status != 0
    assert "FAILED" in text


@compiled
def test_a_parameter_outside_its_limits_is_found(tmp_path):
    files = pj.export(CONTROLLERS["p753_pid"](), tmp_path / "c", about=ABOUT)
    program = tmp_path / "c" / "program.c"
    program.write_text(
        '#include "controller.h"\n'
        "int main(void) {\n"
        "    controller_parameters changed = controller_defaults();\n"
        "    if (controller_check(&changed)) return 100;\n"
        "    changed.controller_anti_windup = -1.0;\n"
        "    return controller_check(&changed);\n"
        "}\n"
    )
    binary = tmp_path / "program"
    subprocess.run(
        ["cc", "-std=c99", "-o", binary, program, files[1], "-lm"], check=True
    )
    assert subprocess.run([binary]).returncode == 5  # the fifth parameter


DRIVE = series(
    limits=pj.Saturation(-20.0, 120.0),
    slew=SlewLimit(1e5, 5e-5),
    converter=Quantiser(0.01),
)


@compiled
@pytest.mark.parametrize("axes", [1, 3])
def test_the_limits_of_parameters_inside_parts_are_found(axes, tmp_path):
    drive = DRIVE if axes == 1 else PerAxis((DRIVE,) * axes, ("z", "x", "y"))
    controller = CONTROLLERS["p753_pid" if axes == 1 else "p558_pid"]()
    about = ABOUT.model_copy(
        update={"actuator": to_data(drive), "reference_ranges": [(0.0, 10.0)] * axes}
    )
    header, source, *_ = pj.export(controller, tmp_path / "c", about=about)
    at = "actuator_parts_" if axes == 1 else "actuator_parts_2_parts_"
    fields = header.read_text().partition("} controller_parameters;")[0]
    rows = fields.rpartition("typedef struct {\n")[2].splitlines()
    changes = {}  # number of each field in the struct
    for field, meaning in (
        ("1_rate", "slew rate, above 0, unit V/s"),
        ("2_resolution", "step of the converter, above 0, unit V"),
    ):
        row = f"    double {at}{field}; /* {meaning} */"
        changes[f"{at}{field}"] = 1 + rows.index(row)
    if axes > 1:  # a field of the controller's part of an axis
        name = "controller_parts_1_anti_windup"
        (row,) = (row for row in rows if row.startswith(f"    double {name};"))
        assert "at least 0, unit 1/s" in row
        changes[name] = 1 + rows.index(row)
    (tmp_path / "program.c").write_text(
        f'#include <stdio.h>\n#include "{header}"\n'
        "int main(void) {\n"
        "    controller_parameters p = controller_defaults(), changed = p;\n"
        '    printf("%d\\n", controller_check(&p));\n'
        + "".join(
            f"    changed = p;\n    changed.{name} = -1.0;\n"
            '    printf("%d\\n", controller_check(&changed));\n'
            for name in changes
        )
        + "    return 0;\n}\n"
    )
    command = ["cc", "-std=c99", "-o", "program", "program.c", source, "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "program"], capture_output=True, text=True)
    assert done.stdout.split() == ["0", *map(str, changes.values())]


@compiled
def test_parameters_changed_while_running_act_once_prepared(tmp_path):
    controller: Any = CONTROLLERS["p753_disturbance_observer"]()
    changed = eqx.tree_at(lambda c: c.cutoff, controller, 0.5 * controller.cutoff)
    _, source, *_ = pj.export(controller, tmp_path / "c", about=ABOUT)
    (tmp_path / "c" / "program.c").write_text(
        "#include <stdio.h>\n"
        '#include "controller.h"\n'
        "int main(void) {\n"
        "    controller_parameters p = controller_defaults();\n"
        "    controller_state state;\n"
        "    int k;\n"
        "    controller_init(&state, &p, 5.0, 5.0, 5.0, 40.0);\n"
        "    for (k = 0; k < 20; k++) {\n"
        "        if (k == 10) {\n"
        "            p.controller_cutoff *= 0.5;\n"
        "            controller_prepare(&p);\n"
        "        }\n"
        '        printf("%.17g\\n", controller_step(&state, &p, 5.0, 5.1, 4.9));\n'
        "    }\n"
        "    return 0;\n"
        "}\n"
    )
    command = ["cc", "-std=c99", "-o", "program", "program.c", source, "-lm"]
    subprocess.run(command, cwd=tmp_path / "c", check=True)
    done = subprocess.run([tmp_path / "c" / "program"], capture_output=True, text=True)
    actuator = pj.Saturation(-20.0, 120.0)
    at = jnp.asarray(5.0)
    state = Driven(controller, actuator).init(pj.Observation(at, at, at, 8.0 * at))
    seen, wanted = Seen(at, at + 0.1, at - 0.1), []
    for k in range(20):
        system = Driven(controller if k < 10 else changed, actuator)
        state, voltage = system.step(state, seen)
        wanted.append(float(voltage))
    found = [float(line) for line in done.stdout.split()]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    unchanged = Driven(controller, actuator)
    assert abs(float(unchanged.step(state, seen)[1]) - found[-1]) > 1e-6


@compiled
def test_a_step_computes_nothing_that_depends_on_parameters_alone(tmp_path):
    controller = CONTROLLERS["p753_disturbance_observer"]()
    _, source, *_ = pj.export(controller, tmp_path / "c", about=ABOUT)
    step = source.read_text().partition("controller_step(")[2]
    assert "/ parameters" not in step
    assert "parameters->controller_cutoff" not in step


# The text


def test_the_same_gains_give_the_same_text(tmp_path):
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        pj.export(CONTROLLERS["p753_inversion"](), folder, about=ABOUT)
    one, other = (
        {path.name: path.read_text() for path in folder.iterdir()} for folder in folders
    )
    assert one == other
    assert set(one) == {
        *("controller.h", "controller.c", "test_controller.c"),
        *("vectors.csv", "Makefile"),
    }


def test_the_files_name_their_origin_and_units(tmp_path):
    paths = pj.export(
        CONTROLLERS["p753_pid"](), tmp_path / "c", about=ABOUT, name="pid"
    )
    assert len(paths) == 5
    header = paths[0]
    for path in paths:
        text = path.read_text()
        assert "Study: a study, seed 3." in text
        assert "Sampling rate: 20000 Hz" in text
        assert "Judged: tuned loop: sensitivity peak 1.5." in text
        assert "Plants: gain +- 10 %; mode_frequency 3600 to 4400." in text
    assert "proportional gain P, unit V/um" in header.read_text()
    assert "void pid_init(pid_state *state," in header.read_text()


def test_the_limits_are_those_of_the_study_unless_given(tmp_path):
    def lower(folder, **options):
        source = pj.export(CONTROLLERS["p753_pid"](), folder, about=ABOUT, **options)[1]
        return source.read_text().partition("actuator_lower = ")[2].partition(";")[0]

    assert lower(tmp_path / "a") == "-20.0"
    assert lower(tmp_path / "b", limits=[(1.5, 9.0)]) == "1.5"


def test_numbers_of_c_are_exact():
    for value in (0.1, -1e-300, 3.0, 1e22, 5e-324):
        assert float(DOUBLE.number(value)) == value
        assert set(DOUBLE.number(value)) & set(".e")


# What is refused


def test_gains_with_an_alarm_are_refused_unless_accepted(tmp_path):
    about = ABOUT.model_copy(update={"unsafe": ["it rings"]})
    controller = CONTROLLERS["p753_pid"]()
    with pytest.raises(
        ValueError, match=r"an alarm: it rings; to export it all the same"
    ):
        pj.export(controller, tmp_path / "c", about=about)
    assert not (tmp_path / "c").exists()
    header, *_ = pj.export(controller, tmp_path / "c", about=about, accept_unsafe=True)
    assert header.read_text().startswith("/* UNSAFE: it rings")


def test_a_controller_without_limits_is_refused(tmp_path):
    with pytest.raises(ValueError, match="the limits of the voltage are unknown"):
        pj.export(CONTROLLERS["p753_pid"](), tmp_path / "c", accept_unsafe=True)
    assert not (tmp_path / "c").exists()


def test_a_controller_that_no_study_judged_is_refused_unless_accepted(tmp_path):
    controller, limits = CONTROLLERS["p753_pid"](), [(0.0, 1.0)]
    with pytest.raises(ValueError, match="no study has judged the stability"):
        pj.export(controller, tmp_path / "c", limits=limits)
    header, *_ = pj.export(
        controller, tmp_path / "c", limits=limits, accept_unsafe=True
    )
    assert header.read_text().startswith("/* UNSAFE: no study has judged")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "a-b"}, "the name 'a-b' is not one of C"),
        ({"precision": "half"}, "precision 'half': choose from double, float"),
    ],
)
def test_bad_options_are_refused(options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        pj.export(CONTROLLERS["p753_pid"](), tmp_path / "c", about=ABOUT, **options)


@pytest.mark.parametrize(
    ("system", "samples", "message"),
    [
        (PLANTS["p753"], 99, "samples is 99; a plant needs at least 100"),
        (CONTROLLERS["p753_pid"], 0, "samples is 0; a controller needs at least 1"),
    ],
)
def test_too_few_samples_are_refused(system, samples, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        pj.export(system(), tmp_path / "c", about=ABOUT, samples=samples)


class Sorted(pj.System):
    """A System whose step has no form in scalar operations."""

    gain: jax.Array = parameter("1", "gain")

    def init(self, input=0.0):
        return jnp.zeros(3)

    def step(self, state, input):
        state = jnp.sort(jnp.append(state[1:], self.gain * input))
        return state, state[1]


def test_a_system_without_scalar_form_is_refused_with_the_operation(tmp_path):
    with pytest.raises(NotScalarError, match="its operation sort has no scalar form"):
        pj.export(Sorted(2.0), tmp_path / "c")


def test_a_system_with_other_inputs_is_refused(tmp_path):
    class Labelled(pj.System):
        def init(self, input):
            return input["a"]

        def step(self, state, input):
            return input["a"], state

    with pytest.raises(ValueError, match="only those can be exported"):
        pj.export(Labelled(), tmp_path / "c")


class Swapped(pj.System):
    """Two long arrays that change places, of which one starts as a parameter."""

    table: jax.Array = parameter("1", "table", converter=jnp.asarray)

    def init(self, input=0.0):
        return self.table, jnp.full(self.table.shape, input)

    def step(self, state, input):
        return (state[1], state[0]), state[0][7] + 10.0 * state[1][299] + input


@compiled
def test_long_arrays_are_copied_where_they_move(tmp_path):
    pj.export(Swapped(np.arange(300.0)), tmp_path / "c")
    status, text = made(tmp_path / "c")
    assert status == 0, text


class Grid(pj.System):
    """A long table of two axes, of which rows and elements are taken."""

    table: jax.Array = parameter("1", "table", converter=jnp.asarray)

    def init(self, input=0.0):
        return self.table, jnp.zeros((), jnp.int32)

    def step(self, state, input):
        table, k = state
        row = table[k % 3]
        table = table.at[k % 3, 2 * k % 200].add(input)
        return (table, k + 1), row[k % 200] + table[(k + 1) % 3, 7] + table[0, 0]


@compiled
def test_rows_and_elements_of_a_long_table_are_those_of_jax(tmp_path):
    pj.export(Grid(np.arange(600.0).reshape(3, 200)), tmp_path / "c")
    status, text = made(tmp_path / "c")
    assert status == 0, text


# The trace


def run(function, *arguments):
    """Return the outputs of the statements of ``function``, run as Python."""
    graph, outputs = trace(function, *arguments)
    values = [float(x) for leaf in jax.tree.leaves(arguments) for x in np.ravel(leaf)]
    known = {}
    for number in graph.block.order:
        node = graph.nodes[number]
        operands = [known[n] for n in node.operands]
        if node.operation == CONSTANT:
            known[number] = node.value
        elif node.operation == INPUT:
            known[number] = values[node.value]
        elif node.operation == "select_n":
            known[number] = operands[1 + int(operands[0])]
        else:
            known[number] = {
                "add": lambda a, b: a + b,
                "sub": lambda a, b: a - b,
                "mul": lambda a, b: a * b,
                "max": max,
                "abs": abs,
                "lt": lambda a, b: a < b,
                "ge": lambda a, b: a >= b,
                "eq": lambda a, b: a == b,
                "clamp": lambda a, b, c: min(max(a, b), c),
                "convert_element_type": lambda a: a,
            }[node.operation](*operands)
    return np.array([known[n] for each in outputs for n in each.ravel().tolist()])


@pytest.mark.parametrize(
    "function",
    [
        lambda a, b: a @ b,
        lambda a, b: (a.T[::-1] + b).sum(axis=0),
        lambda a, b: jnp.where(a < b, a, 2.0 * b)[1:, 0],
        lambda a, b: jnp.max(jnp.concatenate([a, b], axis=1), axis=1),
        lambda a, b: jax.lax.cond(a[0, 0] < 1.0, lambda: a[0], lambda: b[0]),
        lambda a, b: jax.lax.scan(lambda c, x: (c + x, c * x), b[0], a)[1],
        lambda a, b: jnp.einsum("ij,jk,ik->k", a, b, a),
        lambda a, b: jax.lax.dynamic_slice(a[0], (a[1, 1].astype(int),), (1,)),
        lambda a, b: a[0].at[b[1, 1].astype(int)].add(3.0),
        lambda a, b: a.at[1, 2].add(b[0, 0]),
        lambda a, b: a.at[jnp.array([2, 0, 2])].add(b),
        lambda a, b: jax.vjp(lambda x: jnp.stack([x[1], x[0] * x[0, 0]]), a)[1](b[:2]),
    ],
)
def test_arrays_become_the_scalars_that_jax_computes(function):
    a = jnp.array([[1.5, -2.0, 4.0], [3.0, 1.0, -1.0], [0.5, 2.5, 7.0]])
    b = jnp.array([[2.0, 5.0, -3.0], [1.0, 2.0, -7.0], [0.25, 4.0, 1.0]])
    wanted = np.ravel(function(a, b))
    np.testing.assert_allclose(run(function, a, b), wanted, rtol=1e-14)


def test_a_loop_of_unknown_length_stays_a_loop():
    def halved(x):
        return jax.lax.while_loop(lambda y: y > 1.0, lambda y: 0.5 * y, x)

    graph, (output,) = trace(halved, jnp.asarray(5.0))
    lines, expression = statements(graph, [int(output)], lambda place: "x", DOUBLE)
    text = "\n".join(lines)
    assert "double v0 = x;" in text
    assert "for (;;) {" in text
    assert expression(int(output)) == "v0"


def test_what_does_not_change_in_a_loop_is_computed_before_it():
    def powers(x, y):
        return jax.lax.while_loop(lambda z: z < x, lambda z: z * (y + 1.0), y)

    graph, (output,) = trace(powers, jnp.asarray(50.0), jnp.asarray(2.0))
    assert [graph.nodes[n].operation for n in graph.block.order if n >= 0].count("add")
    assert prepared_nodes(graph, [int(output)], 1) == []
    (loop,) = prepared_nodes(graph, [int(output)], 2)
    assert graph.nodes[loop].operation == "result"


def test_a_product_with_a_sign_and_its_signal_has_no_branch():
    def decay(x, y):
        return jnp.where(x >= 0.0, 0.5, -0.5) * y * x

    graph, (output,) = trace(decay, jnp.asarray(-3.0), jnp.asarray(2.0))
    operations = [graph.nodes[n].operation for n in graph.needed([int(output)])]
    assert "abs" in operations
    assert "select_n" not in operations


@pytest.mark.parametrize("rounded", [False, True])
def test_a_quotient_that_is_rounded_stays_one(rounded):
    def scaled(step, x):
        return jnp.round(x / step) if rounded else x / step

    graph, (output,) = trace(scaled, jnp.asarray(0.1), jnp.asarray(0.3))
    shorten_products(graph, 1)
    last = graph.nodes[graph.nodes[int(output)].operands[0] if rounded else int(output)]
    assert last.operation == ("div" if rounded else "mul")


def test_equal_operations_are_computed_once():
    graph, outputs = trace(lambda x: (x * x + 1.0, x * x + 1.0), jnp.asarray(2.0))
    assert outputs[0] == outputs[1]
    assert sum(node.operation == "mul" for node in graph.nodes) == 1


def test_the_voltage_goes_back_to_the_controller_after_its_limits():
    system = Driven(CONTROLLERS["p753_pid"](), pj.Saturation(0.0, 1.0))
    at = jnp.asarray(5.0)
    state = system.init(pj.Observation(at, at, at, jnp.asarray(0.5)))
    state, voltage = system.step(state, Seen(at + 100.0, at, at))
    assert voltage == 1.0
    assert state.applied == 1.0
    assert state.controller.command > 1.0
