import gc
import os
import tempfile

import jax
import pytest
from hypothesis import settings

# The same examples in every run: a red run can be repeated, a green one is no luck.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


# Most programs of the tests run once: compiling them well takes longer than running
# them badly. Commands that tests start inherit this.
jax.config.update("jax_disable_most_optimizations", True)
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "true"
# Nor does a test look where in the source an operation of a program stands.
jax.config.update("jax_traceback_in_locations_limit", 0)
os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"


@pytest.fixture
def optimised():
    """Compile the programs of a test well, because they run long."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


# Tracing makes many small objects, of which few are garbage.
gc.set_threshold(100_000, 20, 20)


ONE_THREAD = "--xla_cpu_parallel_codegen_split_count=1"


def pytest_configure(config):
    """Let all workers and commands of a run share what they compile, each on a core.

    Most of the time goes into compiling, and many files compile the same loops.
    """
    if hasattr(config, "workerinput") or "PIEZOJAX_COMPILATION_CACHE" in os.environ:
        return
    folder = tempfile.TemporaryDirectory(prefix="piezojax-programs-")
    os.environ["PIEZOJAX_COMPILATION_CACHE"] = folder.name
    config.add_cleanup(folder.cleanup)
    # There is a worker for each core: a compiler of several threads gains nothing.
    flags = [os.environ.get("XLA_FLAGS", ""), ONE_THREAD]
    os.environ["XLA_FLAGS"] = " ".join(flags).strip()


def pytest_collection_modifyitems(items):
    """Begin with the files that take long: the workers then end at the same time.

    Those are the files that hold a slow test, and those that compile whole studies.
    """
    long = {
        item.path
        for item in items
        if item.get_closest_marker("slow") or item.path.parent.name == "tuning"
    }
    items.sort(key=lambda item: item.path not in long)


def pytest_sessionfinish():
    """Look for leaks once: pytest would five times, in gigabytes of traced programs."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def kept_programs():
    """Small compiled programs are shared too: a loop made again costs its tracing."""
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
