import pytest

from piezojax.engines import native_kernel
from piezojax.engines import native_library as library


@pytest.fixture
def no_libraries(monkeypatch):
    """Compile every library anew."""
    monkeypatch.setattr(library, "_kept", lambda name: None)
    monkeypatch.setattr(library, "_libraries", {})


@pytest.fixture
def compiled(monkeypatch, no_libraries):
    """Return a list that gains an entry for each compiled library."""
    found = []
    compile_ = library._compiled
    monkeypatch.setattr(
        library, "_compiled", lambda *a: found.append(a) or compile_(*a)
    )
    return found


@pytest.fixture
def sources(monkeypatch):
    """Return a list of the sources of kernels, each with its number of inputs."""
    found, register = [], library.registered
    monkeypatch.setattr(
        native_kernel, "registered", lambda *a: found.append(a) or register(*a)
    )
    return found


@pytest.fixture
def failing_compiler(monkeypatch, no_libraries):
    monkeypatch.setattr(library, "compiler", lambda: "/bin/false")
