"""The tracer: photons and rays through a scene, tallied as responses or as absorbed energy.

Responses keep geometry apart from optics, by scattering history; where histories would be too many, optics
are applied while light is traced.
"""
