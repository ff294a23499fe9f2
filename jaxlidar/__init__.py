"""jaxlidar."""
