"""The commands `jaxlidar prospect` and `jaxlidar spectra`."""

from pathlib import Path

import click
import numpy as np

from jaxlidar.cli.shared import PLOT_OPTION, new_axes, out_option, save_figure
from jaxlidar.io import atomic_write
from jaxlidar.optics.coefficients import TRAITS
from jaxlidar.optics.prospect import Prospect
from jaxlidar.optics.spectra import spectrum, spectrum_names

WAVELENGTHS = (532.0, 1064.0, 1550.0)
# All versions but PRO, whose coefficients are not bundled: its authors distribute them.
VERSIONS = tuple(version for version in TRAITS if version != "PRO")


@click.command()
@click.option("--N", "N", type=float, default=1.5, help="Number of elementary plates.")
@click.option("--Cab", "Cab", type=float, help="Chlorophyll, ug/cm2.  [default: 40]")
@click.option("--Car", "Car", type=float, help="Carotenoids, ug/cm2.  [default: 8]")
@click.option("--Cant", "Cant", type=float, help="Anthocyanins, ug/cm2.  [default: 0]")
@click.option("--Cbrown", "Cbrown", type=float, help="Brown pigments.  [default: 0]")
@click.option("--Cw", "Cw", type=float, help="Water, cm.  [default: 0.01]")
@click.option("--Cm", "Cm", type=float, help="Dry matter, g/cm2.  [default: 0.009]")
@click.option("--Cp", "Cp", type=float, help="Protein, g/cm2; version PC.  [default: 0.001]")
@click.option("--Cc", "Cc", type=float, help="Cellulose and lignin, g/cm2; version PC.  [default: 0.009]")
@click.option("--version", type=click.Choice(VERSIONS), default="D", help="Version of the coefficients.")
@click.option("--at", type=float, multiple=True, default=WAVELENGTHS, help="Wavelength, nm; repeat for more.")
@out_option("Write the spectrum from 400 to 2500 nm as CSV.")
@PLOT_OPTION
def prospect(at: tuple[float, ...], out: Path | None, plot: Path | None, **traits: float) -> None:
    """Print the reflectance and transmittance of a leaf by the PROSPECT model.

    \b
    Examples:
      jaxlidar prospect --N 1.5 --Cab 40 --plot leaf.png
      jaxlidar prospect --Cw 0.02 --at 1064 -o leaf.csv
    """
    leaf = Prospect(**traits)  # pyright: ignore[reportArgumentType]
    R, T = leaf(np.array(at))
    click.echo("     nm  reflectance  transmittance  absorptance")
    for wavelength, r, t, a in zip(at, R, T, leaf.absorptance(np.array(at))):
        click.echo(f"{wavelength:7g}  {float(r):11.4f}  {float(t):13.4f}  {float(a):11.4f}")
    if out is not None:
        grid = np.arange(400.0, 2501.0)
        rows = np.column_stack([grid, *map(np.asarray, leaf(grid))])
        with atomic_write(out) as draft:
            header = "wavelength_nm,reflectance,transmittance"
            np.savetxt(draft, rows, delimiter=",", header=header, comments="", fmt=("%g", "%.7g", "%.7g"))
        click.echo(f"spectrum: {out}")
    if plot is not None:
        from jaxlidar.plot import spectrum as draw_spectrum

        axes = new_axes(5.0, 3.0)
        draw_spectrum(leaf, axes)
        save_figure(axes, plot)


@click.command()
@click.argument("kind", required=False)
@PLOT_OPTION
def spectra(kind: str | None, plot: Path | None) -> None:
    """List the bundled reflectance spectra, of one KIND (bark, wood, litter, char, soil, built) or of all.

    \b
    Examples:
      jaxlidar spectra
      jaxlidar spectra soil --plot soils.png
    """
    kind_of_name = spectrum_names(kind)
    width = max(map(len, kind_of_name))
    click.echo(f"{'name':{width}}  {'kind':6}  " + "  ".join(f"{w:4.0f} nm" for w in WAVELENGTHS))
    for name, material in kind_of_name.items():
        values = "  ".join(f"{float(r):7.2f}" for r in spectrum(name)(np.array(WAVELENGTHS)))
        click.echo(f"{name:{width}}  {material:6}  {values}")
    if plot is not None:
        from jaxlidar.plot import spectrum as draw_spectrum

        axes = new_axes(5.0, 3.0)
        for name in kind_of_name:
            draw_spectrum(spectrum(name), axes)
        save_figure(axes, plot)
