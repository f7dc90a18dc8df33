"""Simulate, identify and tune piezo nanopositioning stages."""

import lazy_loader

from .core import runtime

__version__ = "0.1.0"

runtime.configure()

# The names are those of __init__.pyi, each imported when it is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
