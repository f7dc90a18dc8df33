import gc
import os
import tempfile

import jax
import pytest
from hypothesis import settings
from jax.experimental.compilation_cache import compilation_cache

# The same examples in every run: a red run can be repeated, a green one is no luck.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


def pytest_configure(config):
    """Let all workers and commands of a run share what they compile.

    Most of the time goes into compiling, and many files compile the same loops.
    """
    if hasattr(config, "workerinput") or "PIEZOJAX_COMPILATION_CACHE" in os.environ:
        return
    folder = tempfile.TemporaryDirectory(prefix="piezojax-programs-")
    os.environ["PIEZOJAX_COMPILATION_CACHE"] = folder.name
    config.add_cleanup(folder.cleanup)


def pytest_sessionfinish():
    """Look for leaks once: pytest would five times, in gigabytes of traced programs."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module")
def kept_programs(tmp_path_factory):
    """A folder of compiled programs: loops of one structure are compiled once."""
    folder = str(tmp_path_factory.mktemp("programs"))
    options = {
        "jax_compilation_cache_dir": folder,
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    before = {name: getattr(jax.config, name) for name in options}
    for name, value in options.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    yield folder
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
