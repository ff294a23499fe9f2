"""The response tracer: from geometry to the geometric weight of every scattering history."""
