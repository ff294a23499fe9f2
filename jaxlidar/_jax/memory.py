"""The memory of this machine, and bytes in words."""

import os


def machine_memory() -> float:
    """Return the bytes of memory of this machine; 8 GB where the system does not tell."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):
        return 8e9


def format_bytes(size: float) -> str:
    """Format a number of bytes as GB, MB or kB, to two digits."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= factor:
            return f"{float(f'{size / factor:.2g}'):g} {unit}"
    return f"{size:.0f} bytes"
