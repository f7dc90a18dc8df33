"""Table of the mutations: a wrong line, and the tests that must fail with it."""

from typing import NamedTuple


class Mutation(NamedTuple):
    """``old`` becomes ``new`` in ``file`` (of the package); ``tests`` must then fail.

    ``old`` occurs in the file exactly once. ``tests`` are arguments of pytest.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


_CHAIN = "tests/engines/test_shorter_chain.py"
_DATA = "tests/tuning/test_data.py"
_ENGINES = "tests/engines/test_engines_for_lanes.py"
_LOOPS = "tests/control/test_loops.py"
_REVERSE = "tests/engines/test_reverse_mode.py"
_ROBUST = "tests/tuning/test_robust.py"
_MULTI_AXIS = ("tests/control/test_multi_axis.py", "-k", "published")

MUTATIONS = (
    # Many lanes in compiled C
    Mutation(
        "a maximum that drops NaN",
        "engines/native_writer.py",
        '"max": "(({a} > {b}) | ({a} != {a})) ? {a} : {b}"',
        '"max": "{a} > {b} ? {a} : {b}"',
        (_ENGINES, "-k", "nan"),
    ),
    Mutation(
        "outer lanes with the state of the first",
        "engines/native_templates.py",
        "start + block * $carried * STRIDE",
        "start + 0 * block * $carried * STRIDE",
        (_ENGINES, "-k", "number_of_lanes"),
    ),
    Mutation(
        "inputs of a single lane in the shape of all lanes",
        "engines/batch.py",
        "mine = any(where[a] is not None and self.sizes[a] > 1 for a in group)",
        "mine = any(where[a] is not None for a in group)",
        (_ENGINES, "-k", "its_inputs"),
    ),
    Mutation(
        "directions that stay in turn where lanes are few",
        "engines/native_source.py",
        "math.ceil(directions * inner / GROUP) * (values + slopes) < together",
        "math.ceil(directions * inner / GROUP) * (values + slopes) < 0 * together",
        (_ENGINES, "-k", "become_lanes"),
    ),
    Mutation(
        "a sum of few lanes with the sign of an inner term",
        "engines/shorter_chain.py",
        "Term(outer.sign * inner.sign, factor, inner.node)",
        "Term(inner.sign, factor, inner.node)",
        (_CHAIN, "-k", "equal"),
    ),
    Mutation(
        "derivatives of the state that vanish for good",
        "engines/scalar_step.py",
        "if left == vanish:",
        "if left is not None:",
        (_ENGINES, "-k", "derivatives"),
    ),
    Mutation(
        "a sum that vanishes with one of its terms",
        "engines/scalar_step.py",
        'any if node.operation == "mul" else all',
        "any",
        (_ENGINES, "-k", "derivatives"),
    ),
    Mutation(
        "a loop of fixed length that no kernel has",
        "engines/scalar_step.py",
        "partial(trace, rolled=math.inf)",
        "partial(trace, rolled=8)",
        (_ENGINES, "-k", "loops_in_c"),
    ),
    Mutation(
        "an exponential with one term less",
        "engines/native_math.py",
        "range(13, 1, -1)",
        "range(12, 1, -1)",
        ("tests/engines/test_native_math.py", "-k", "exact"),
    ),
    Mutation(
        "choices of lanes that become branches",
        "engines/native_templates.py",
        '"no-tree-pre", "no-tree-sink", ',
        '"no-tree-pre", ',
        ("tests/engines/test_native_math.py", "-k", "simd"),
    ),
    Mutation(
        "a reverse pass without the first segment",
        "engines/native_templates.py",
        "segment = segments - 1; segment >= 0;",
        "segment = segments - 1; segment > 0;",
        (_REVERSE, "-k", "start"),
    ),
    Mutation(
        "states that depend on tuned numbers only through others",
        "engines/adjoint_step.py",
        "if not more:",
        "if more is not None:",
        (_REVERSE, "-k", "many_lanes"),
    ),
    # Signals of a study
    Mutation(
        "hold-out noise from the tuning's stream",
        "tuning/data.py",
        "[_STREAMS[part]]",
        "[0]",
        (_DATA,),
    ),
    Mutation(
        "validation residual from the training part",
        "tuning/unexplained.py",
        "for one in residual.parts[part]\n        for played",
        'for one in residual.parts["train"]\n        for played',
        (_DATA,),
    ),
    Mutation(
        "drift without the root of the sample time",
        "tuning/data.py",
        "* np.sqrt(case.study.dt)",
        "* case.study.dt",
        (_ROBUST, "-k", "drift"),
    ),
    Mutation(
        "one noise draw for all references",
        "tuning/data.py",
        "return as_array(random.standard_normal(shape))",
        "return as_array(0.0 * random.standard_normal(shape)"
        " + random.standard_normal(shape[1:]))",
        (_DATA,),
    ),
    Mutation(
        "hold-out plants from the tuning's stream",
        "study/ensemble.py",
        'stream = 3 if part == "holdout" else 2',
        "stream = 2",
        (_ROBUST, "-k", "holdout_and_tuning"),
    ),
    Mutation(
        "SW without its shift",
        "signals/waveforms.py",
        "t = time - 0.1",
        "t = time",
        ("tests/test_signals.py",),
    ),
    # Objective and evaluation
    Mutation(
        "a lost plant needs saturation in all runs",
        "tuning/objective.py",
        "railed = jnp.any(",
        "railed = jnp.all(",
        (_DATA,),
    ),
    Mutation(
        "nominal plant left out of the mean",
        "tuning/objective.py",
        "return jnp.mean(joined)",
        "return jnp.mean(joined[1:] if joined.size > 1 else joined)",
        (_ROBUST, "-k", "aggregated"),
    ),
    Mutation(
        "perturbed plants start with the nominal holding voltage",
        "tuning/evaluator.py",
        "around, own = stage.around(loop), signals.on(stage)",
        "around, own = stage.around(loop), signals",
        (_DATA,),
    ),
    Mutation(
        "perturbed plants are tuned from the nominal holding voltage",
        "tuning/objective.py",
        "self.signals.on(stage),",
        "self.signals,",
        (_DATA,),
    ),
    Mutation(
        "measured instead of true error",
        "core/metrics.py",
        "error = output.displacement - output.reference",
        "error = output.measured - output.reference",
        ("tests/test_metrics.py",),
    ),
    Mutation(
        "window one sample late",
        "core/metrics.py",
        "inside = jnp.where(index >= self.start, 1.0, 0.0)",
        "inside = jnp.where(index > self.start, 1.0, 0.0)",
        ("tests/test_metrics.py",),
    ),
    # Stability and limit
    Mutation(
        "Ms on one branch",
        "analysis/stability/small_motion.py",
        "jnp.asarray([*BRANCHES.values()])",
        "jnp.asarray([*BRANCHES.values()][:1] * 2)",
        ("tests/analysis/test_differentiable_margins.py", "-k", "every_branch"),
    ),
    Mutation(
        "delay margin without crossings with phase lead",
        "analysis/stability/margins.py",
        "samples = float((lag / places).min())",
        "samples = float(np.where(lag < np.pi, lag / places, np.inf).min())",
        ("tests/analysis/test_differentiable_margins.py", "-k", "lead"),
    ),
    Mutation(
        "delay margin of a response without crossings with phase lead",
        "analysis/stability/sampled_margins.py",
        "smallest(jnp.where(crosses, lag",
        "smallest(jnp.where(crosses & (lag < jnp.pi), lag",
        ("tests/analysis/test_differentiable_margins.py", "-k", "lead"),
    ),
    Mutation(
        "settled when the band is entered first",
        "analysis/step_response.py",
        "error.size - 1 - jnp.argmax(outside[::-1])",
        "jnp.argmin(outside) - 1",
        ("tests/analysis/test_step_response.py",),
    ),
    Mutation(
        "delay not counted by the limit",
        "analysis/limit/wiener.py",
        "response = w**delay",
        "response = w**0",
        ("tests/analysis/test_wiener.py",),
    ),
    # The loop and its hardware
    Mutation(
        "controller sees the command",
        "core/feedback.py",
        "            displacement,\n            voltage,\n        )",
        "            displacement,\n            command,\n        )",
        ("tests/test_system.py", _LOOPS),
    ),
    Mutation(
        "slew per sample",
        "hardware.py",
        "most = self.rate * self.dt",
        "most = self.rate",
        ("tests/test_hardware.py",),
    ),
    Mutation(
        "sign of the charge drive's leakage",
        "hardware.py",
        "+ self.dt * leakage",
        "- self.dt * leakage",
        ("tests/test_charge_drive.py",),
    ),
    # Controllers
    Mutation(
        "sign of D of the sliding variable",
        "control/switching.py",
        "i - p - d / self.dt",
        "i - p + d / self.dt",
        _MULTI_AXIS,
    ),
    Mutation(
        "integral used one sample late",
        "control/switching.py",
        "            integral,\n            _times(self.proportional, input)",
        "            state.integral,\n            _times(self.proportional, input)",
        (_LOOPS,),
    ),
    Mutation(
        "start with a bump of 2 %",
        "control/sliding_mode.py",
        "needed = applied *",
        "needed = 1.02 * applied *",
        (_LOOPS, "-k", "away_from_zero"),
    ),
    Mutation(
        "anti-windup dropped",
        "control/pid.py",
        "self.anti_windup * shortfall",
        "0.0 * shortfall",
        (_LOOPS,),
    ),
    Mutation(
        "c_1 with the square",
        "control/disturbance_observer.py",
        "(0.5 + x) * a + (0.5 - x) * b",
        "(0.5 + x) * a + (0.5 - 0.5 * x) * b",
        (_LOOPS,),
    ),
    Mutation(
        "cut-off in Hz",
        "control/disturbance_observer.py",
        "x = 1.0 / (self.cutoff * self.dt)",
        "x = 6.283185307179586 / (self.cutoff * self.dt)",
        (_LOOPS,),
    ),
    Mutation(
        "start memory swapped",
        "control/disturbance_observer.py",
        "memory=tuple(terms)[::-1],",
        "memory=tuple(terms),",
        (_LOOPS, "-k", "away_from_zero"),
    ),
    Mutation(
        "surface reversed",
        "control/model_reference.py",
        "return newest + dot(reversed(self.surface), older)",
        "return newest + dot(self.surface, older)",
        ("tests/control/test_chapter4.py",),
    ),
    Mutation(
        "r(k) shifted, r(k+1) not",
        "control/anticipation.py",
        "return now + rise, following + rise",
        "return now + rise, following",
        ("tests/control/test_anticipation.py",),
    ),
    Mutation(
        "input one sample older",
        "control/kalman.py",
        "zip(self.model.moving, inputs, strict=True)",
        "zip(self.model.moving, (*inputs[1:], inputs[-1]), strict=True)",
        ("tests/control/test_kalman.py",),
    ),
    Mutation(
        "forgetting ten times faster",
        "control/recursive_weights.py",
        "forgetting = jnp.exp(-self.dt / self.memory)",
        "forgetting = jnp.exp(-10.0 * self.dt / self.memory)",
        ("tests/control/test_adaptive_inverse.py",),
    ),
    Mutation(
        "half the width",
        "control/switching.py",
        "jnp.clip(sliding / self.width",
        "jnp.clip(2.0 * sliding / self.width",
        ("tests/control/test_boundary_layer.py",),
    ),
    # Models
    Mutation(
        "direct part of creep ignored",
        "dynamics/creep.py",
        "output = self.direct * input\n        for gain, lag",
        "output = input\n        for gain, lag",
        ("tests/dynamics/test_creep.py", "tests/dynamics/test_creep_separation.py"),
    ),
    Mutation(
        "direct part of logarithmic creep ignored",
        "dynamics/creep.py",
        "output = self.direct * input\n        for lag in",
        "output = input\n        for lag in",
        ("tests/dynamics/test_creep.py", "tests/dynamics/test_creep_separation.py"),
    ),
    Mutation(
        "spread of creep ignored",
        "catalog/p753_stage.py",
        "share * (1.0 + creep)",
        "share",
        (_ROBUST, "-k", "deviation"),
    ),
    Mutation(
        "creep ten times smaller",
        "catalog/p753_stage.py",
        '"gains": (0.01, 0.01, 0.01)',
        '"gains": (0.001, 0.001, 0.001)',
        (_ROBUST, "-k", "deviation"),
    ),
    Mutation(
        "mode frequency with 6 for 2 pi",
        "catalog/p753_stage.py",
        "2.0 * jnp.pi * mode_frequency",
        "6.0 * mode_frequency",
        (_ROBUST, "-k", "deviation"),
    ),
    Mutation(
        "poles the other way",
        "catalog/p753_stage.py",
        "jnp.exp((1.0 + faster)",
        "jnp.exp((1.0 - faster)",
        (_ROBUST, "-k", "rays"),
    ),
    Mutation(
        "delay doubled",
        "catalog/p753_stage.py",
        "as_array(delay) * p753.DT",
        "as_array(delay) * 2.0 * p753.DT",
        (_ROBUST, "-k", "deviation"),
    ),
    Mutation(
        "hysteresis spread in a alone",
        "catalog/p753_stage.py",
        'material["c"] * (1.0 + hysteresis)',
        'material["c"]',
        (_ROBUST, "-k", "deviation"),
    ),
    # Hysteresis that a plant lacks
    Mutation(
        "plays with the radius as their diameter",
        "signals/missing_hysteresis.py",
        "places[:, k] - radii, places[:, k] + radii",
        "places[:, k] - 0.5 * radii, places[:, k] + 0.5 * radii",
        ("tests/test_missing_hysteresis.py",),
    ),
    Mutation(
        "a hysteresis that disturbs every run",
        "tuning/unexplained.py",
        "total[:, 0] = missing",
        "total[:] = missing",
        (_DATA, "-k", "assumed"),
    ),
    Mutation(
        "a gain that is wrong in one direction",
        "tuning/unexplained.py",
        "total[:, 1] -= wrong",
        "total[:, 1] += wrong",
        (_DATA, "-k", "parts"),
    ),
    Mutation(
        "a gain as wrong as in training",
        "tuning/unexplained.py",
        "name) for one in residual.parts[part]",
        'name) for one in residual.parts["train"]',
        (_DATA, "-k", "wrong_gain"),
    ),
    Mutation(
        "margins without the largest gain",
        "tuning/evaluator.py",
        "others += [level_stages(case.loop), steep_stage(case)]",
        "others += [level_stages(case.loop)]",
        ("tests/tuning/test_steep_stage.py",),
    ),
    # Outputs that were saved early
    Mutation(
        "early outputs that hide their resonance",
        "identification/estimators/resonances.py",
        "early > EARLY and (negative or better)",
        "early > EARLY and negative",
        ("tests/identification/test_resonance.py", "-k", "early"),
    ),
    Mutation(
        "early outputs by a model that fits worse",
        "identification/estimators/resonances.py",
        "early > EARLY and (negative or better)",
        "early > EARLY",
        ("tests/identification/test_resonance.py", "-k", "early"),
    ),
    # The input before a record
    Mutation(
        "a record that begins without a step, at rest somewhere else",
        "identification/estimators/output_error.py",
        "structure = structure.with_before(records[0].input)",
        "structure = structure.without(())",
        ("tests/identification/test_input_before.py",),
    ),
    # Several records
    Mutation(
        "plays of several records that are as wide as their cycles",
        "identification/chain.py",
        "before=1.0 + 2.0 * BEYOND if beside else 1.0",
        "before=1.0",
        ("tests/identification/test_wide_plays.py",),
    ),
    Mutation(
        "fits of several records that end with their first prior",
        "identification/estimators/output_error.py",
        "settled = turn > int(alone) and losses[0] > PASSED * past",
        "settled = turn > 0",
        ("tests/identification/test_vague_parameters.py",),
    ),
    Mutation(
        "states before a record in which every sample counts",
        "identification/estimators/start_search.py",
        "samples = errors.size / independent(errors)",
        "samples = 1.0",
        ("tests/identification/test_validation.py",),
    ),
    Mutation(
        "states before a record from the samples that depend on them alone",
        "identification/validation.py",
        "+ round(AFTER * record.samples)",
        "+ 1",
        ("tests/identification/test_validation.py",),
    ),
    Mutation(
        "past samples, nearly equal at a high rate, in place of their differences",
        "identification/estimators/refined.py",
        "    if differences:",
        "    if False:",
        ("tests/identification/test_second_sight.py",),
    ),
    Mutation(
        "a weak mode searched from least squares alone",
        "identification/estimators/hammerstein.py",
        "if signals.fitted and best is not None:",
        "if False and best is not None:",
        ("tests/identification/test_second_sight.py",),
    ),
    Mutation(
        "a slew rate from the first look alone",
        "identification/second_sight.py",
        "slew = last.slew if behind.slew is None else behind.slew",
        "slew = last.slew",
        ("tests/identification/test_second_sight.py", "tests/dynamics/test_slew.py"),
    ),
    Mutation(
        "a displacement that is delayed along straight lines",
        "dynamics/delay.py",
        "cls(0.5 * dt, dt, 5, order=3),",
        "cls(0.5 * dt, dt, 5),",
        ("tests/dynamics/test_delay.py",),
    ),
    Mutation(
        "a second look that starts at the defaults of its parts",
        "identification/second_sight.py",
        "nearest(replace(found, values))",
        "nearest(replace(system, values))",
        ("tests/identification/test_second_sight.py",),
    ),
    Mutation(
        "models of several records compared before their fits settle",
        "identification/automatic.py",
        "if len(begun) > 1 else ()",
        "if len(begun) > 9 else ()",
        ("tests/identification/test_automatic.py",),
    ),
    Mutation(
        "a longer fit that takes the place of a better one",
        "identification/automatic.py",
        "found is not None and found.losses[0] < last.fit.losses[0]",
        "found is not None",
        ("tests/identification/test_automatic.py",),
    ),
    Mutation(
        "a density whose many weights count for nothing in the choice",
        "identification/automatic.py",
        "left = 1.0 - found.weights.freedom / independent",
        "left = 1.0",
        ("tests/identification/test_automatic.py",),
    ),
    Mutation(
        "weights that are fitted at a poor guess of the dynamics",
        "identification/estimators/output_error.py",
        "units = np.concatenate([units[:1], again])",
        "units = np.concatenate([again, units[:1]])",
        ("tests/identification/test_linear_weights.py",),
    ),
    Mutation(
        "weights whose prior follows errors that it has made itself",
        "identification/estimators/linear_weights.py",
        "light.best_at(free, light.likeliest_scale(free))",
        "first.best_at(free, first.likeliest_scale(free))",
        ("tests/identification/test_linear_weights.py",),
    ),
    Mutation(
        "no word of weights that the records do not determine",
        "identification/methods.py",
        "weights.freedom > weights.above.size - 0.5",
        "weights.freedom > 0.0",
        ("tests/identification/test_linear_weights.py",),
    ),
    Mutation(
        "a memory that is corrected before a record like a linear state",
        "identification/estimators/linear_start.py",
        "count = sum(leaf.size for leaf in jax.tree.leaves(state))\n"
        "    return not hystereses(system) or count <= few",
        "return True",
        ("tests/identification/test_output_error.py",),
    ),
    Mutation(
        "standard errors that take fitted weights for known ones",
        "identification/estimators/linear_weights.py",
        "slopes.T @ slopes - crossed.T @ self.inverse @ crossed,",
        "slopes.T @ slopes,",
        ("tests/identification/test_linear_weights.py",),
    ),
    # Limits of the reference
    Mutation(
        "a limited reference that brakes too late",
        "control/limited_reference.py",
        "0.5 * most * (steps - 1.0)",
        "0.6 * most * (steps - 1.0)",
        ("tests/control/test_limited_reference.py",),
    ),
    # Alarms that did not come
    Mutation(
        "a device at its own limit that is not saturated",
        "core/metrics.py",
        "clipped = clipped | held",
        "clipped = clipped & True",
        ("tests/control/test_at_limit.py",),
    ),
    Mutation(
        "an unstable plant whose short runs look fine",
        "tuning/result.py",
        "lost |= ~np.asarray(figures.stable)",
        "lost |= False",
        ("tests/tuning/test_slow_modes.py",),
    ),
    Mutation(
        "margins of a slow oscillation from its first 0.2 s",
        "tuning/evaluator.py",
        "SETTLED, MOST = 7.0,",
        "SETTLED, MOST = 0.0,",
        ("tests/tuning/test_slow_modes.py",),
    ),
    Mutation(
        "a search with the first 0.2 s of a slow oscillation",
        "study/case.py",
        "SEARCHED, MOST_SEARCHED = 4.0,",
        "SEARCHED, MOST_SEARCHED = 0.0,",
        ("tests/tuning/test_slow_modes.py", "-k", "search"),
    ),
    Mutation(
        "steps that ignore the constraints they meet",
        "solve/sampled_errors.py",
        "slack = ~(terms > 0.0)",
        "slack = terms > np.inf",
        ("tests/tuning/test_gauss_newton.py",),
    ),
    Mutation(
        "corrections that ignore the constraints a step has met",
        "solve/local_model.py",
        "self._meeting(residuals[slack.places] > 0.0) if slack else self",
        "self",
        ("tests/tuning/test_gauss_newton.py",),
    ),
    Mutation(
        "a search without a reserve for other plants",
        "tuning/limited_search.py",
        "RESERVE = 0.01",
        "RESERVE = 0.0",
        ("tests/tuning/test_robust.py", "-k", "reserve"),
    ),
    Mutation(
        "gains without the alarms of the plant that a study accepts",
        "tuning/model_alarms.py",
        "yield from about.unsafe",
        "yield from about.unsafe if fitted else ()",
        ("tests/test_plants_of_studies.py", "-k", "alarms"),
    ),
    Mutation(
        "margins at the end of the references that is nearer to rest",
        "study/case.py",
        "below = np.abs(low - rest) > np.abs(high - rest)",
        "below = np.abs(low - rest) < np.abs(high - rest)",
        ("tests/tuning/test_margin_reference.py",),
    ),
    Mutation(
        "zeros of several sensors as motion to explain",
        "identification/estimators/projection.py",
        "return found - found.mean(axis=0) if len(found) else found",
        "return found",
        ("tests/identification/test_identify.py", "-k", "zero_of_another"),
    ),
    # Searches
    Mutation(
        "drawn plants judged by the short responses of a search",
        "tuning/evaluator.py",
        "margins, _ = self._margins_of_stable(loop, stages)",
        "margins = self._margins(loop, stages)",
        ("tests/tuning/test_slow_modes.py", "-k", "ring_longer"),
    ),
    Mutation(
        "the limit of a search that is not tightened for drawn plants",
        "tuning/limited_search.py",
        "peak = max(_alarming_peak(case, stability), carried.peak)",
        "peak = _alarming_peak(case, stability)",
        ("tests/tuning/test_limited_search.py", "-k", "rings_longer"),
    ),
    Mutation(
        "a search as long as the oscillation of the nominal plant alone",
        "study/case.py",
        "if drawn is not None:",
        "if drawn is None:",
        ("tests/tuning/test_slow_modes.py", "-k", "ring_longer"),
    ),
    Mutation(
        "a second search without the end of the first",
        "tuning/limited_search.py",
        "return min(search, other, key=lambda state: state.rank)",
        "return search",
        ("tests/tuning/test_safe_by_default.py",),
    ),
)
"""All mutations; see ``run.py``."""
