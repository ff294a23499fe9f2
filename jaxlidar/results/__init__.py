"""Results as data sets: cases that repeat a simulation, netCDF files, and the store of long runs."""
