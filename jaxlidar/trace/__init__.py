"""The response tracer: geometry to the geometric weight of every scattering history."""

from .response import Response, trace

__all__ = ["Response", "trace"]
