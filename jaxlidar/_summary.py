"""Text of a printed waveform."""

from typing import Any

import numpy as np

# Light that a record misses is reported from this fraction of the emitted light on.
NOTABLE_FRACTION = 0.01


def percent(fraction: float) -> str:
    """Format a fraction in percent with two significant digits."""
    # Rounded as text first, as "g" alone writes 100 as 1e+02.
    return f"{float(f'{100 * fraction:.2g}'):g} %"


def outside_fraction(wave: Any) -> float:
    """Return the largest fraction, of all wavelengths, of light that is in flight when the record ends."""
    return float(np.max(np.asarray(wave.energy_budget["after the window"]), initial=0.0))


def truncated_fraction(wave: Any) -> float:
    """Return the largest bound, of all wavelengths, on what untraced orders may add to the waveform."""
    total = np.asarray(wave.reflectance).sum(axis=1)
    return float(np.max(np.asarray(wave.neglected) / np.maximum(total, 1e-30), initial=0.0))


def unfollowed_message(orders: int, fraction: float) -> str:
    """Return the text of the warning that orders beyond the last may add a fraction of the light."""
    return (
        f"orders of scattering beyond {orders} may add {percent(fraction)} of the light: give "
        "max_orders=, or fewer wavelengths at once, for which more orders are followed"
    )


def summary(wave: Any) -> str:
    """Describe a waveform in a few lines: its samples, energy budget and accuracy; many scenes in one."""
    wavelengths, total = np.asarray(wave.wavelength, float), np.asarray(wave.reflectance).sum(axis=-1)
    n_columns = min(len(wavelengths), 4)
    time = np.asarray(wave.time, float)
    interval = time[1] - time[0] if time.size > 1 else 0.0
    samples = f"{time.size} samples of {interval:.3g} ns from {time[0]:.6g} ns"
    if wave.has_scenes:
        return f"{len(wave)} waveforms of {samples}, at {', '.join(f'{w:g}' for w in wavelengths)} nm"
    title = f"Waveform of {samples}"
    rows = {
        "wavelength (nm)": [f"{w:g}" for w in wavelengths[:n_columns]],
        "apparent reflectance": [f"{r:.4g}" for r in total[:n_columns]],
        **{
            f"{name} (% of the light)": [f"{100 * float(f):.3g}" for f in np.asarray(fractions)[:n_columns]]
            for name, fractions in wave.energy_budget.items()
            # Fates that would be printed as 0.00 % are left out.
            if name != "returned" and np.max(np.asarray(fractions)) >= 5e-5
        },
    }
    if n_columns < len(wavelengths):
        for cells in rows.values():
            cells.append("...")
    width = max(map(len, rows))
    lines = [
        title,
        *(f"  {name.ljust(width)}  " + "  ".join(c.rjust(8) for c in cells) for name, cells in rows.items()),
    ]
    if outside_fraction(wave) >= NOTABLE_FRACTION:
        lines.append(
            f"  {percent(outside_fraction(wave))} of the light is still on its way when the record ends"
        )
    if truncated_fraction(wave) >= NOTABLE_FRACTION:
        lines.append(f"  orders beyond the last may add {percent(truncated_fraction(wave))}")
    info = wave.info
    if info:
        lines.append(
            f"  {info.get('photons', 0):,} photons in {info.get('seconds', 0.0):.2g} s, relative error "
            f"{info.get('error', 0.0):.2g}: {info.get('stopped', '')}"
        )
    return "\n".join(lines)
