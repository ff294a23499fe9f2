"""Physical constants in the package's units (CODATA 2018, exact by definition of the SI).

**Example:** the range of a target whose echo arrives 6671.3 ns after the pulse was sent, in m.

>>> import jaxlidar as jl
>>> print(f"{0.5 * jl.SPEED_OF_LIGHT * 6671.3:.1f}")
1000.0
"""

SPEED_OF_LIGHT = 0.299792458
"""Speed of light in vacuum, m/ns."""

PLANCK_TIMES_LIGHT = 6.62607015e-34 * 299792458.0 * 1e9
"""h c in J nm: a photon of wavelength `w` nm carries `PLANCK_TIMES_LIGHT / w` J."""
