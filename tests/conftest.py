import atexit
import gc
import os
import shutil
import tempfile
from pathlib import Path

# Each core has a worker: further threads of linear algebra would wait for
# each other in a busy loop. Read when NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# Every run has the same examples, so that failures are reproducible.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


# Most programs of the tests run once: optimised compilation takes longer than running
# unoptimised code. Commands that tests start inherit this setting.
jax.config.update("jax_disable_most_optimizations", True)
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "true"
# Tests do not need the source locations of the operations of a program.
jax.config.update("jax_traceback_in_locations_limit", 0)
os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"

# The workers share what they compile: many tests need the same programs. The first
# process makes the folder and removes it; the others find it in the environment.
PROGRAMS = "PIEZOJAX_TEST_PROGRAMS"
if PROGRAMS not in os.environ:
    os.environ[PROGRAMS] = tempfile.mkdtemp(prefix="piezojax-programs-")
    atexit.register(shutil.rmtree, os.environ[PROGRAMS], ignore_errors=True)
jax.config.update("jax_compilation_cache_dir", os.environ[PROGRAMS])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.01)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
# Commands in processes of their own use that folder too, not that of the user.
os.environ.setdefault("PIEZOJAX_COMPILATION_CACHE", os.environ[PROGRAMS])


@pytest.fixture
def optimised():
    """Compile the programs of a test with optimisation, because they run long."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


@pytest.fixture
def undrawn(monkeypatch):
    """Write pictures of one pixel and pages without curves.

    Drawing takes most of the time of a command on a small study; this is for tests of
    commands that read neither pictures nor curves.
    """
    from matplotlib.figure import Figure
    from PIL import Image

    from piezojax.report import page

    def save(self, file, **_):
        Image.new("RGB", (1, 1)).save(file, "png")

    monkeypatch.setattr(Figure, "savefig", save)
    monkeypatch.setattr(page, "live_figures", lambda *_: page.LiveFigures())


# Tracing creates many small objects; few of them are garbage.
gc.set_threshold(100_000, 20, 20)


# Each core has a worker: a compiler with several threads is not faster.
ONE_THREAD = "--xla_cpu_parallel_codegen_split_count=1"
os.environ.setdefault("XLA_FLAGS", ONE_THREAD)


# Functions of these take anything, or walk through programs, and are called so often
# that checking them would take a fifth of all time.
UNCHECKED = {
    *(f"piezojax.core.{name}" for name in ("arrays", "parameter", "paths")),
    "piezojax.engines.lane_values",
    "piezojax.scalar.trace",
}


def modules_with_arrays():
    """Yield the modules that import types of arrays, but not the ``UNCHECKED`` ones."""
    package = Path(__file__).parents[1] / "piezojax"
    for path in package.rglob("*.py"):
        name = ".".join(path.relative_to(package.parent).with_suffix("").parts)
        text = path.read_text(encoding="utf-8")
        imports = "from jaxtyping import" in text or "arrays import" in text
        if imports and name not in UNCHECKED:
            yield name


# Shapes and types of their annotated functions are checked while the tests run.
install_import_hook([*modules_with_arrays()], "beartype.beartype")


@pytest.fixture(autouse=True, scope="module")
def forgotten():
    """Forget traces and programs after each file: compiling slows down with them."""
    yield
    jax.clear_caches()


def pytest_collection_finish():
    """Leave out of every collection of garbage what the imports created."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items):
    """Start with the slow files, so that the workers end at the same time.

    These are the files with a slow test and those that compile whole studies.
    """
    long = {
        item.path
        for item in items
        if item.get_closest_marker("slow") or item.path.parent.name == "tuning"
    }
    items.sort(key=lambda item: item.path not in long)


def pytest_sessionfinish():
    """Collect garbage once: pytest would collect gigabytes of programs five times."""
    gc.collect()
    gc.freeze()
