"""The modules with sampled mutants, and the fast tests of each."""

_AXES = ("tests/analysis/test_multi_axis_margins.py",)
_MARGINS = ("tests/analysis/test_margins.py", *_AXES)
_LIMIT = (
    "tests/analysis/test_performance_limit.py",
    "tests/analysis/test_wiener.py",
    "tests/analysis/test_verification.py",
)
_PLANTS = ("tests/test_plants_of_studies.py",)
_RESULTS = ("tests/tuning/test_alarms.py", "tests/tuning/test_tuner.py")
_STUDY = (
    *("tests/test_study.py", "tests/test_study_hardware.py"),
    "tests/tuning/test_axes.py::test_a_bad_study_is_refused",
    "tests/tuning/test_robust.py::test_a_bad_study_is_refused",
    "tests/tuning/test_goals.py::test_impossible_limits_are_refused",
    "tests/tuning/test_goals.py::test_several_axes_have_no_bandwidth",
)
_SWEPT = ("tests/sweeping/test_plan.py",)
_SUMMARIES = ("tests/tuning/test_result.py",)

MODULES = {
    "core/metrics.py": ("tests/test_metrics.py",),
    "tuning/alarms.py": (
        "tests/tuning/test_alarms.py",
        "tests/tuning/test_goals.py::test_a_loop_that_amplifies_its_reference_has_a_note",
        *("-k", "not command"),
    ),
    "tuning/reach.py": ("tests/tuning/test_reach.py", "-k", "not shipped"),
    "tuning/objective.py": (
        *("tests/tuning/test_objective.py", "tests/tuning/test_data.py"),
        *("tests/tuning/test_robust.py", "tests/tuning/test_tuner.py"),
    ),
    "tuning/result.py": (*_SUMMARIES, *_RESULTS),
    "tuning/make_result.py": (*_SUMMARIES, *_RESULTS, *_PLANTS),
    "tuning/tuner.py": (
        *_PLANTS,
        "tests/tuning/test_structures.py::test_structures_are_one_search_at_a_time",
        "tests/tuning/test_tuner.py",
    ),
    "study/case.py": (
        "tests/tuning/test_margin_reference.py",
        "tests/tuning/test_slow_modes.py",
    ),
    "study/make_case.py": (
        *(*_STUDY, "tests/test_measured_noise.py"),
        *("tests/tuning/test_beside.py", *_SWEPT),
    ),
    "study/sources.py": _STUDY,
    "study/parameters.py": _STUDY,
    "study/schema.py": (*_STUDY, "tests/test_json_schema.py"),
    "analysis/stroke.py": ("tests/analysis/test_stroke.py",),
    "analysis/stability/assess.py": (
        *_MARGINS,
        "tests/analysis/test_operating_point.py",
    ),
    "analysis/stability/crossings.py": _MARGINS,
    "analysis/stability/margins.py": _MARGINS,
    "analysis/stability/sampled_margins.py": (
        "tests/analysis/test_differentiable_margins.py",
    ),
    "analysis/stability/axes_margins.py": _AXES,
    "analysis/limit/performance.py": _LIMIT,
    "analysis/limit/spectra.py": _LIMIT,
    "analysis/limit/wiener.py": _LIMIT,
}
"""Arguments of pytest by the module's file in the package."""
