"""What a waveform says of itself when it is printed."""

from typing import Any

import numpy as np

# From this share of the emitted light on, what the record misses is worth a word.
NOTABLE = 0.01


def percent(share: float) -> str:
    """A share in percent, to two digits, also of 100."""
    return f"{float(f'{100 * share:.2g}'):g} %"


def late_share(wave: Any) -> float:
    """Largest share, of all wavelengths, of light that is on its way when the record ends."""
    return float(np.max(np.asarray(wave.energy_budget["after the window"]), initial=0.0))


def beyond_share(wave: Any) -> float:
    """Largest share, of all wavelengths, that orders beyond the last may add to the waveform."""
    whole = np.asarray(wave.reflectance).sum(axis=1)
    return float(np.max(np.asarray(wave.neglected) / np.maximum(whole, 1e-30), initial=0.0))


def summary(wave: Any) -> str:
    """A few lines: what was simulated, what became of the light, how well it is known."""
    wavelengths, total = np.asarray(wave.wavelength, float), np.asarray(wave.reflectance).sum(axis=1)
    shown = min(len(wavelengths), 4)
    time = np.asarray(wave.time, float)
    interval = time[1] - time[0] if time.size > 1 else 0.0
    head = f"Waveform of {time.size} samples of {interval:.3g} ns from {time[0]:.6g} ns"
    rows = {
        "wavelength (nm)": [f"{w:g}" for w in wavelengths[:shown]],
        "apparent reflectance": [f"{r:.4g}" for r in total[:shown]],
        **{
            f"{name} (% of the light)": [f"{100 * float(s):.3g}" for s in np.asarray(share)[:shown]]
            for name, share in wave.energy_budget.items()
            if name != "returned" and np.max(np.asarray(share)) >= 5e-5
        },
    }
    if shown < len(wavelengths):
        for cells in rows.values():
            cells.append("...")
    width = max(map(len, rows))
    lines = [
        head,
        *(f"  {name.ljust(width)}  " + "  ".join(c.rjust(8) for c in cells) for name, cells in rows.items()),
    ]
    if late_share(wave) >= NOTABLE:
        lines.append(f"  {percent(late_share(wave))} of the light is still on its way when the record ends")
    if beyond_share(wave) >= NOTABLE:
        lines.append(f"  orders beyond the last may add {percent(beyond_share(wave))}")
    info = wave.info
    if info:
        lines.append(
            f"  {info.get('photons', 0):,} photons in {info.get('seconds', 0.0):.2g} s, relative error "
            f"{info.get('error', 0.0):.2g}: {info.get('stopped', '')}"
        )
    return "\n".join(lines)
