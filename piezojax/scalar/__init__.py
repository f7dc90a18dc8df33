"""Scalar operations of a JAX function, and their source in C."""

from .graph import Graph as Graph
from .memory import NotScalarError as NotScalarError
from .trace import trace as trace
