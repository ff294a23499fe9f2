"""Spectral domains in which leaf traits are fitted."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

# Feret et al. (2019), Remote Sens. Environ. 231, 110959 (Cw, Cm); Feret et al. (2021), 252, 112173 (Cp, Cc);
# Spafford et al. (2021), 252, 112176 (Cab, Car). Other traits have none.
RECOMMENDED = {
    "Cab": ((700.0, 720.0),),
    "Car": ((520.0, 560.0),),
    "Cw": ((1700.0, 2400.0),),
    "Cm": ((1700.0, 2400.0),),
}

Intervals = tuple[tuple[float, float], ...]


def domains_of(
    domain: str | Mapping[str, Any] | None, names: Sequence[str]
) -> dict[Intervals, tuple[str, ...]]:
    """The unknowns of every domain, by its intervals; those that have none are left out."""
    if domain is None:
        return {}
    if isinstance(domain, str):
        if domain != "recommended":
            raise ValueError(f"domain = {domain!r} is none of None, 'recommended' and a mapping")
        given = {name: RECOMMENDED[name] for name in names if name in RECOMMENDED}
    else:
        given = {name: _intervals(name, value) for name, value in domain.items()}
    groups: dict[Intervals, tuple[str, ...]] = {}
    for name, intervals in given.items():
        if name not in names:
            raise ValueError(f"domain: {name!r} is none of the unknowns {', '.join(names)}")
        groups[intervals] = (*groups.get(intervals, ()), name)
    return groups


def _intervals(name: str, value: Any) -> Intervals:
    try:
        pairs = np.atleast_1d(np.asarray(value, float))
        pairs = pairs.reshape(1, 2) if pairs.shape == (2,) else pairs
    except (TypeError, ValueError):
        pairs = np.empty((0, 2))
    if pairs.shape != (len(pairs), 2) or len(pairs) == 0 or not np.all(pairs[:, 0] <= pairs[:, 1]):
        raise ValueError(
            f"domain: {name} = {value!r} is neither a pair (low, high), nm, low <= high, nor several of them"
        )
    return tuple((low, high) for low, high in pairs.tolist())


def bands_of(
    wavelengths: Float[np.ndarray, " wavelengths"], intervals: Intervals, names: Sequence[str]
) -> tuple[Bool[np.ndarray, " wavelengths"], Float[np.ndarray, "intervals 2"]]:
    """Which wavelengths lie in the intervals, and the first and last of them in each."""
    within, ends = np.zeros(wavelengths.size, bool), []
    for low, high in intervals:
        here = (wavelengths >= low) & (wavelengths <= high)
        found = wavelengths[here]
        if found.size == 0 or np.ptp(found) < 0.5 * (high - low):
            raise ValueError(
                f"wavelengths {np.min(wavelengths):g} to {np.max(wavelengths):g} nm do not span half of "
                f"{low:g} to {high:g} nm, the domain of {', '.join(names)}: give these bands, another domain "
                "or other unknowns"
            )
        within |= here
        ends.append((found.min(), found.max()))
    return within, np.array(ends)
