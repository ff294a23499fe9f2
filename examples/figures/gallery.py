"""Make the pictures of examples/README.md: run it as `python examples/figures/gallery.py`.

Those of notebooks are taken from their stored results, so that both show the same.
"""

import base64
import json
import runpy
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import jaxlidar as jl
import jaxlidar.plot
from jaxlidar.io import atomic_write, read_case

EXAMPLES = Path(__file__).resolve().parents[1]
GALLERY = EXAMPLES / "figures" / "gallery"
# Number of the picture of each notebook that the gallery shows, from 0.
CHOSEN = {
    "first_waveform": 1,
    "leaf_traits": 3,
    "ground_under_trees": 2,
    "peak_detectors": 0,
    "hectare": 1,
    "strip": 3,
    "neural_posterior": 0,
    "own_loss": 0,
    "recorded_shots": 0,
    "gedi_file": 0,
    "photon_track": 1,
}


def picture(notebook: str) -> bytes:
    """Return the picture (PNG) of a notebook for the gallery."""
    cells = json.loads((EXAMPLES / "notebooks" / f"{notebook}.ipynb").read_text())["cells"]
    data = [output.get("data", {}) for cell in cells for output in cell.get("outputs", [])]
    stored = [formats["image/png"] for formats in data if "image/png" in formats]
    return base64.b64decode("".join(stored[CHOSEN[notebook]]))


def scenes() -> Figure:
    """Draw the tree of the cases of the paper, from its file."""
    case = read_case(EXAMPLES / "scenes" / "tree.toml")
    figure, ax = plt.subplots(figsize=(4.5, 4.0), layout="constrained")
    jaxlidar.plot.scene(case.scene, case.lidar, ax)
    return figure


def paper() -> Figure:
    """Draw Figure 1 of the paper."""
    figure = plt.figure(figsize=(6.0, 3.5), layout="constrained")
    axes = [figure.add_subplot(1, 2, i, projection="3d") for i in (1, 2)]
    jaxlidar.plot.leaf_on_and_off(jl.grow(jl.broadleaf(), seed=0), axes, max_buds=2000)
    return figure


def minnaert() -> Figure:
    """Draw the reflectance of slopes by two laws of reflection."""
    minnaerts = runpy.run_path(str(EXAMPLES / "minnaert.py"))["Minnaert"]
    figure, ax = plt.subplots(figsize=(4.5, 3.0), layout="constrained")
    slopes = np.arange(0.0, 75.0, 5.0)
    laws = {"Lambertian": jl.Lambertian(), "Minnaert, k = 1.5": minnaerts(k=1.5)}
    for (name, law), colour in zip(laws.items(), ("#0072B2", "#D55E00")):
        scenes = [jl.Scene(ground=jl.Ground(reflectance=0.3, slope=slope, law=law)) for slope in slopes]
        waves = [jl.simulate(jl.Lidar(), scene, key=jax.random.key(0)) for scene in scenes]
        ax.plot(slopes, [float(wave.reflectance.sum()) for wave in waves], color=colour, label=name)
    ax.set(xlabel="slope of the ground (degrees)", ylabel="apparent reflectance", ylim=(0, None))
    ax.legend(frameon=False)
    return figure


def _reduce_colours(path: Path) -> None:
    """Store a picture with a palette: thousands of points with soft edges do not compress well.

    Colours of few points, such as those of a wire, stay where a palette covers the range of all.
    """
    with Image.open(path) as picture:
        methods, no_dither = Image.Quantize, Image.Dither.NONE
        reduced = picture.convert("RGB").quantize(48, methods.MAXCOVERAGE, dither=no_dither)
    with atomic_write(path) as draft:
        reduced.save(draft, format="png", optimize=True)


def main() -> None:
    """Write all pictures."""
    GALLERY.mkdir(exist_ok=True)
    for notebook in CHOSEN:
        with atomic_write(GALLERY / f"{notebook}.png") as draft:
            draft.write_bytes(picture(notebook))
    for draw in (scenes, paper, minnaert):
        with atomic_write(GALLERY / f"{draw.__name__}.png") as draft:
            draw().savefig(draft, dpi=80, format="png")
    for script in ("bimodal", "spectrum_and_waveform", "street"):
        runpy.run_path(str(EXAMPLES / f"{script}.py"))["main"](["--out", str(GALLERY)])
    _reduce_colours(GALLERY / "street.png")


if __name__ == "__main__":
    main()
