"""The response tracer: from the geometry of a scene to the weight of every scattering history."""
