import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from piezojax.core import runtime as _runtime

THRESHOLD = (
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"
)
LASTING = (
    THRESHOLD,
    "--xla_cpu_prefer_vector_width=512",
    "--xla_cpu_copy_insertion_use_region_analysis=true",
)
REMOVED = "--xla_cpu_use_fusion_emitters=false"  # in jaxlib 0.11.2
FLAGS = LASTING if jax.__version_info__ >= (0, 11, 1) else (*LASTING, REMOVED)


OURS = (
    "XLA_FLAGS",
    "PIEZOJAX_COMPILATION_CACHE",
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_ENABLE_X64",
)


def python(code, **variables):
    """Run ``code`` in a new interpreter without the flags of this one."""
    environment = {
        name: value for name, value in os.environ.items() if name not in OURS
    }
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**environment, **variables},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


SIMULATE = """
from piezojax.catalog import p753
from piezojax import simulate
state, outputs = simulate(p753.plant(), jnp.ones(10))
print(outputs.dtype)
"""


def test_float64_is_enabled():
    assert jax.config.read("jax_enable_x64")
    assert jnp.zeros(()).dtype == jnp.float64


def test_a_fresh_import_sets_every_flag_once_and_keeps_no_programs():
    done = python(
        "import os, piezojax, jax, jax.numpy as jnp\n"
        "print(os.environ['XLA_FLAGS'])\n"
        "print(jax.config.jax_compilation_cache_dir)" + SIMULATE
    )
    assert done.returncode == 0, done.stderr
    flags, folder, dtype = done.stdout.splitlines()
    assert sorted(flags.split()) == sorted(FLAGS)
    assert folder == "None"
    assert dtype == "float64"
    assert "Warning" not in done.stderr


def test_flags_of_the_user_are_kept():
    own = "--xla_cpu_prefer_vector_width=256 --xla_cpu_enable_fast_math=false"
    done = python(
        "import piezojax, jax.numpy as jnp, os; print(os.environ['XLA_FLAGS'])\n"
        "jnp.ones(1)",
        XLA_FLAGS=own,
    )
    assert done.returncode == 0, done.stderr
    flags = done.stdout.splitlines()[0]
    assert flags.startswith(own)
    assert sorted(flags.split()) == sorted([*own.split(), FLAGS[0], *FLAGS[2:]])


def test_the_threshold_is_added_to_extra_options_of_the_user():
    own = "--xla_backend_extra_options=xla_cpu_emitter_verification_level=0"
    done = python(
        "import piezojax, jax.numpy as jnp, os; print(os.environ['XLA_FLAGS'])\n"
        "jnp.ones(1)",
        XLA_FLAGS=own,
    )
    assert done.returncode == 0, done.stderr
    assert sorted(done.stdout.splitlines()[0].split()) == sorted([own, *FLAGS])


TOO_LATE = "import jax; jax.devices(); import piezojax; print(jax.numpy.ones(1).dtype)"


def test_an_import_after_jax_started_warns():
    done = python(TOO_LATE)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "float64"
    assert "RuntimeWarning: piezojax was imported after JAX had started" in done.stderr


def test_no_warning_if_the_flags_were_there_before():
    done = python(TOO_LATE, XLA_FLAGS=" ".join(FLAGS), PYTHONWARNINGS="error")
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr


def test_compiled_programs_are_kept_in_the_given_folder(tmp_path):
    folder = tmp_path / "cache"
    done = python(
        "import piezojax, jax, jax.numpy as jnp\n"
        "print(jax.config.jax_compilation_cache_dir)\n"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0.0)"
        + SIMULATE,
        PIEZOJAX_COMPILATION_CACHE=str(folder),
    )
    assert done.returncode == 0, done.stderr
    (inside,) = folder.iterdir()  # named after the versions and the CPU
    assert inside.name.startswith(f"jax{jax.__version__}-jaxlib")
    assert done.stdout.splitlines()[0] == str(inside)
    assert any(inside.iterdir())


KEEP = """
from piezojax.core.runtime import keep_programs
keep_programs()
import piezojax, jax, jax.numpy as jnp
print(jax.config.jax_compilation_cache_dir)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
"""


def kept_in(home, **variables):
    """Simulate with the folder of caches in ``home``; return the programs there."""
    variables |= {"XDG_CACHE_HOME": str(home), "PYTHONWARNINGS": "error"}
    done = python(KEEP + SIMULATE, **variables)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "float64"
    return sorted(path for path in home.rglob("*-cache"))


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME names the folder")
def test_commands_keep_programs_and_compile_damaged_ones_again(tmp_path):
    kept = kept_in(tmp_path)
    assert kept
    assert {path.parent.parent for path in kept} == {tmp_path / "piezojax/programs"}
    for path in kept:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert kept_in(tmp_path) == kept


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME names the folder")
def test_no_programs_are_kept_if_the_variable_is_empty(tmp_path):
    assert not kept_in(tmp_path, PIEZOJAX_COMPILATION_CACHE="")


def test_a_given_folder_of_programs_stays(tmp_path, monkeypatch):
    monkeypatch.delenv(_runtime.CACHE_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = jax.config.jax_compilation_cache_dir
    assert before  # that of conftest.py
    _runtime.keep_programs()
    assert jax.config.jax_compilation_cache_dir == before
    assert not list(tmp_path.iterdir())


def test_the_oldest_programs_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(_runtime, "MOST_KEPT", 250)
    for age in range(4):
        path = tmp_path / "versions" / f"{age}"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    _runtime._remove_oldest(tmp_path)
    left = sorted(path.name for path in tmp_path.glob("*/*"))
    assert left == ["0", "1"]


@pytest.mark.parametrize(
    ("version", "expected"),
    [
        ("0.9.1", ""),
        ("0.9.2", " ".join(LASTING)),
        ("0.10.0", " ".join((*LASTING, REMOVED))),
        ("0.11.0", " ".join((*LASTING, REMOVED))),
        ("0.11.2", " ".join(LASTING)),
        ("0.12.0.1", " ".join(LASTING)),
        ("0.12.1", ""),
        ("1.0.0", ""),
    ],
)
def test_flags_are_set_for_known_versions_only(version, expected, monkeypatch):
    # An unknown flag would abort the process.
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.delenv(_runtime.CACHE_VARIABLE, raising=False)
    monkeypatch.setattr(_runtime, "version", lambda package: version)
    monkeypatch.setattr(_runtime, "_backend_is_running", lambda: False)
    _runtime.configure()
    assert os.environ["XLA_FLAGS"] == expected


def test_threads_simulate_simultaneously_if_asked_before_the_backend_starts():
    done = python(
        "from piezojax.core import runtime as _runtime\n"
        "import jax.numpy as jnp\n"
        "print(_runtime.simulate_side_by_side())\n"
        "jnp.zeros(3)\n"
        "print(_runtime.simulate_side_by_side())\n"
    )
    assert done.stdout.split() == ["True", "True"], done.stderr
    late = python(
        "from piezojax.core import runtime as _runtime\n"
        "import jax.numpy as jnp\n"
        "jnp.zeros(3)\n"
        "print(_runtime.simulate_side_by_side())\n"
    )
    assert late.stdout.split() == ["False"], late.stderr


# Imported packages

LATER = (
    *("scipy.signal", "scipy.stats", "matplotlib", "rich", "click"),
    *("h5py", "xarray", "dask", "cma", "jaxopt"),
)


def imported_by(code):
    done = python(f"import sys\n{code}\nprint(*sys.modules)")
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines()[-1].split())


def test_an_import_loads_no_heavy_packages():
    modules = imported_by("import piezojax")
    assert "piezojax.core.runtime" in modules
    assert modules.isdisjoint({"jax", "scipy", "numpy", "pydantic", *LATER})


def test_used_names_load_their_packages():
    simulation = imported_by("import piezojax; piezojax.simulate; piezojax.PerAxis")
    assert {"jax", "equinox"} < simulation
    assert simulation.isdisjoint({"scipy", "pydantic", *LATER})
    every = imported_by("import piezojax\nfor n in dir(piezojax): getattr(piezojax, n)")
    assert {"piezojax.tuning.tuner", "piezojax.sweeping.sweeper"} < every
    assert every.isdisjoint(LATER)


@pytest.mark.parametrize(
    "command", ["tune", "identify", "export", "start", "excite", "sweep", "reproduce"]
)
def test_help_does_not_wait_for_jax(command):
    modules = imported_by(
        "import runpy\n"
        f"sys.argv = ['piezojax.{command}', '--help']\n"
        "try:\n"
        f"    runpy.run_module('piezojax.{command}', run_name='__main__')\n"
        "except SystemExit as stop:\n"
        "    assert stop.code == 0"
    )
    assert f"piezojax.cli.{command}" in modules
    assert modules.isdisjoint({"jax", "numpy", "scipy", "matplotlib"})
