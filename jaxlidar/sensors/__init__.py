"""Instruments: lidar, pulses, receivers, and surveys of many shots with their scan patterns."""
