"""First order: rays of a quasi-random lattice from the sensor to their first scattering and back."""
