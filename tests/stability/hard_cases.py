"""A table of hard cases: admissible input at the limits, by family, with the variable of the derivative."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class HardCase:
    """One case: its family, the numbers that differ from the usual ones of the family, and tags.

    - `variable`: name of the number that derivatives are with respect to.
    - `kink`: the derivative is one-sided or has no single value there, and must only be finite.
    - `bounds`: errors admitted in single and double precision. Default: those of the family.
    """

    family: str
    name: str
    variable: str
    numbers: Mapping[str, float] = field(default_factory=dict)
    tags: tuple[str, ...] = ()
    kink: bool = False
    bounds: tuple[float, float] | None = None

    def __str__(self) -> str:
        return f"{self.family}: {self.name}"


def family(name: str, *rows: tuple) -> tuple[HardCase, ...]:
    """Make cases from rows of (name, variable, numbers, tags) and, where needed, other fields in a dict."""
    return tuple(HardCase(name, *row[:4], **(row[4] if len(row) > 4 else {})) for row in rows)


KINK = {"kink": True}
FROM_400_KM = {"altitude": 4e5, "divergence": 0.3 / 400, "aperture": 80.0}

GROUND = family(
    "ground",
    ("sums to its reflectance", "rho", {}, ("flat",)),
    ("black", "rho", {"rho": 0.0}, ("R = T = 0",)),
    ("white", "height", {"rho": 1.0}, ("flat",)),
    ("without divergence", "height", {"divergence": 0.0}, ("divergence 0",)),
    ("by divergence, without any", "divergence", {"divergence": 0.0, "slope": 40.0}, ("divergence 0",)),
    ("without jitter", "jitter", {"jitter": 0.0}, ("jitter 0",)),
    ("jitter as long as the pulse", "jitter", {"jitter": 3.0}, ("jitter",)),
    ("a pulse of 1 us", "fwhm", {"fwhm": 1000.0}, ("pulse of 1 us",)),
    ("a pulse of 1 us, moved", "rho", {"fwhm": 1000.0, "height": 2.0}, ("pulse of 1 us",)),
    ("a slope of 80 degrees", "slope", {"slope": 80.0, "divergence": 0.1}, ("grazing",)),
    ("a slope of 89.9 degrees", "rho", {"slope": 89.9, "divergence": 0.0}, ("grazing",)),
    ("zenith of 80 degrees", "rho", {"zenith": 80.0, "divergence": 0.01}, ("grazing",)),
    ("slope facing the beam", "slope", {"slope": 40.0, "zenith": 40.0}, ("grazing",), KINK),
    ("field of view a third of the beam", "fov", {"fov": 0.1}, ("field of view",)),
    ("field of view as wide as the beam", "divergence", {"fov": 0.3}, ("field of view",)),
    ("from 400 km", "height", FROM_400_KM, ("400 km",)),
    ("from 400 km, sloping", "slope", FROM_400_KM | {"slope": 30.0}, ("400 km",)),
    ("far below the reference", "height", {"height": -5.0}, ("flat",)),
)
FINE = family(
    "ground, 0.1 ns",
    ("from 1 km", "height", {"height": 0.7}, ("0.1 ns",)),
    ("from 400 km", "height", FROM_400_KM | {"height": 0.7}, ("0.1 ns", "400 km")),
    ("from 400 km, sloping", "slope", FROM_400_KM | {"slope": 30.0}, ("0.1 ns", "400 km")),
)
SHORT = family(
    "short pulse",
    ("a rectangle", "height", {}, ("flat",)),
    ("of no length", "rho", {"length": 0.0}, ("pulse of 0 ns",)),
    ("of no length, by its length", "length", {"length": 0.0}, ("pulse of 0 ns",), KINK),
    ("of no length, by height", "height", {"length": 0.0}, ("pulse of 0 ns",)),
    ("of no length, by jitter", "jitter", {"length": 0.0}, ("pulse of 0 ns", "jitter 0"), KINK),
    ("of 1 us", "length", {"length": 1000.0}, ("pulse of 1 us",)),
)
EQUAL_ANGLE = family(
    "equal-angle",
    ("at the normal: 2 alpha / pi", "rho", {}, ("normal",)),
    ("at the normal, by slope", "slope", {}, ("normal",)),
    ("at the normal, by aperture", "aperture", {}, ("normal",)),
    ("a slope of the aperture's angle", "slope", {"slope": 0.0057}, ("normal",)),
    ("a slope of 80 degrees", "slope", {"slope": 80.0}, ("grazing",)),
    ("from 400 km", "rho", FROM_400_KM | {"divergence": 0.0}, ("400 km", "normal")),
)
WIDE = {"divergence": 0.3}
MIRROR = family(
    "mirror",
    ("perfect", "rho", WIDE, ("zero-width",)),
    ("perfect, by aperture", "aperture", WIDE, ("zero-width",)),
    ("perfect, by divergence", "divergence", WIDE, ("zero-width",)),
    ("of a beam without divergence", "rho", {}, ("divergence 0",)),
    ("by roughness, without any", "roughness", WIDE, ("zero-width",)),
    ("rough", "roughness", WIDE | {"roughness": 1e-3}, ()),
    ("from 400 km", "rho", {"altitude": 4e5, "divergence": 0.0625, "aperture": 0.8}, ("400 km",)),
)

OBLIQUE = {"zenith": 54.735610317245346, "azimuth": 45.0, "divergence": 0.0}
SLAB_ROWS = (
    ("three layers over ground", "leaf", {}, ()),
    ("nothing absorbs", "R", {"R": 0.6, "T": 0.4, "bark_R": 1.0, "rho": 1.0}, ("R + T = 1",)),
    ("everything absorbs", "R", {"R": 0.0, "T": 0.0, "bark_R": 0.0, "rho": 0.0}, ("R = T = 0",)),
    ("empty", "leaf", {"leaf": 0.0, "bark": 0.0}, ("empty", "p = 0")),
    ("no leaf", "leaf", {"leaf": 0.0}, ("p = 0",)),
    ("no bark", "bark", {"bark": 0.0}, ("p = 0",)),
    ("optical depth 1e-8", "leaf", {"leaf": 1e-8 / 3, "bark": 0.0}, ("optical depth",)),
    ("optical depth 1e4", "leaf", {"leaf": 1e4 / 3, "bark": 0.0}, ("optical depth",)),
    (
        "1e4 in the lowest voxel",
        "leaf",
        {"leaf": 1e4, "bark": 0.0, "low": 1.0, "middle": 0.0, "high": 0.0},
        ("optical depth",),
    ),
    ("1e4 in the middle voxel", "bark", {"leaf": 1e4, "low": 0.0, "high": 0.0}, ("optical depth",)),
    (
        "at 85 degrees",
        "zenith",
        {"zenith": 85.0, "leaf": 0.02, "bark": 0.01, "divergence": 0.0},
        ("grazing",),
        {"bounds": (2e-3, 1e-6)},
    ),
    ("by divergence", "divergence", {}, (), {"bounds": (5e-3, 1e-6)}),
    (
        "by divergence, off nadir",
        "divergence",
        {"zenith": 30.0, "azimuth": 20.0},
        (),
        {"bounds": (5e-3, 1e-5)},
    ),
    ("by altitude, off nadir", "altitude", {"zenith": 30.0, "azimuth": 20.0}, ("400 km",)),
    ("through corners of voxels", "leaf", OBLIQUE | {"x": 0.0, "y": 0.0}, ("corners",)),
)
SLAB = family(
    "slab",
    *SLAB_ROWS,
    ("black leaves", "R", {"R": 0.0, "T": 0.0}, ("R = T = 0",)),
    ("by the reflectance of the ground", "rho", {}, ()),
    ("by the position", "x", {"divergence": 0.0}, ("faces",)),
    ("along the edges of voxels", "leaf", {"divergence": 0.0, "x": 0.0, "y": 0.0}, ("axes", "faces")),
    ("along a face of voxels", "leaf", {"divergence": 0.0, "x": 0.0, "y": 0.5}, ("axes", "faces")),
    ("obliquely within a face", "leaf", OBLIQUE | {"azimuth": 90.0, "x": 0.2, "y": 0.0}, ("faces",)),
    ("without divergence, by it", "divergence", {"divergence": 0.0}, ("divergence 0",)),
    ("ground in the canopy", "height", {"height": 2.3}, ("ground inside",)),
    ("ground in the canopy, by leaf", "leaf", {"height": 1.7}, ("ground inside",)),
    (
        "ground in the canopy, 1e4 deep",
        "height",
        {"height": 2.3, "leaf": 1e4},
        ("ground inside", "optical depth"),
    ),
    ("ground on a face", "height", {"height": 2.0, "low": 1.0}, ("ground inside", "faces")),
    ("ground at the top", "rho", {"height": 4.0}, ("ground inside", "faces")),
    ("ground above the canopy", "height", {"height": 4.5}, ("ground inside",)),
    (
        "slope of 80 degrees",
        "rho",
        {"slope": 80.0, "divergence": 0.0, "x": 0.0, "height": -3.0},
        ("grazing",),
    ),
    (
        "slope of 80 degrees in the canopy",
        "height",
        {"slope": 80.0, "divergence": 0.0, "x": 0.0, "height": 2.3},
        ("grazing", "ground inside"),
    ),
    ("from 100 m", "leaf", {"altitude": 100.0, "divergence": 0.1}, ()),
)
HOT_SPOT = family("slab, hot spot", *SLAB_ROWS)
SMALL = family(
    "one voxel of 1 mm",
    ("optical depth 1", "tau", {}, ("1 mm",)),
    ("by its size", "size", {}, ("1 mm",)),
    ("optical depth 1e-8", "tau", {"tau": 1e-8}, ("1 mm", "optical depth")),
    ("optical depth 1e4", "tau", {"tau": 1e4}, ("1 mm", "optical depth")),
)
LARGE = family(
    "one voxel of 1 km",
    ("optical depth 1", "tau", {}, ("1 km",)),
    ("by its size", "size", {}, ("1 km",)),
    ("optical depth 1e-8", "tau", {"tau": 1e-8}, ("1 km", "optical depth")),
    ("optical depth 1e4", "tau", {"tau": 1e4}, ("1 km", "optical depth")),
)

BLACK = {"R": 0.0, "T": 0.0, "bark_R": 0.0, "divergence": 0.0}
CROWN = family(
    "crown",
    ("ordinary", "R", {}, ("shares",)),
    ("nothing absorbs", "p_leaf", {"R": 0.6, "T": 0.4, "bark_R": 1.0, "rho": 1.0}, ("R + T = 1",)),
    ("leaves only transmit", "T", {"R": 0.0, "T": 1.0}, ("R + T = 1",)),
    ("black", "p_leaf", BLACK, ("R = T = 0",)),
    ("black, and black ground", "rho", BLACK | {"rho": 0.0}, ("R = T = 0",)),
    ("empty", "rho", BLACK | {"p_leaf": 0.0, "p_bark": 0.0}, ("p = 0", "empty")),
    ("empty, by its leaf", "p_leaf", {"p_leaf": 0.0, "p_bark": 0.0}, ("p = 0", "empty")),
    ("solid", "R", {"p_leaf": 1.0, "p_bark": 1.0}, ("p = 1",)),
    ("solid and black, by its leaf", "p_leaf", BLACK | {"p_leaf": 1.0}, ("p = 1",)),
    ("optical depth 1e-8", "p_leaf", {"p_leaf": 1e-8, "p_bark": 0.0}, ("optical depth",)),
    ("along the edges of voxels", "p_leaf", {"divergence": 0.0, "x": 0.0, "y": 0.0}, ("axes", "faces")),
    ("along the side of the map", "x", {"divergence": 0.0, "x": -1.0}, ("faces",)),
    ("along the corner of the map", "y", {"divergence": 0.0, "x": 1.0, "y": 1.0}, ("faces",)),
    ("past the map", "rho", {"divergence": 0.0, "x": 1.5}, ("empty",)),
    ("ground in the canopy", "height", {"height": 2.3}, ("ground inside",)),
    ("ground on a face", "height", {"height": 2.0}, ("ground inside", "faces")),
    ("ground above the canopy", "height", {"height": 4.5}, ("ground inside",)),
    ("slope of 80 degrees", "slope", {"slope": 80.0}, ("grazing",)),
    (
        "slope of 80 degrees in the canopy",
        "slope",
        {"slope": 80.0, "height": 2.5},
        ("grazing", "ground inside"),
    ),
    ("field of view within the footprint", "fov", {"fov": 0.1}, ("field of view",)),
    ("from 400 km", "height", {"altitude": 4e5, "divergence": 1.0 / 400}, ("400 km",)),
    ("without divergence, by it", "divergence", {"divergence": 0.0}, ("divergence 0",)),
)
FORTY_ORDERS = family(
    "40 orders",
    ("albedo 1 over white ground", "albedo", {}, ("albedo 1",)),
    ("albedo 1 over white ground, by depth", "tau", {}, ("albedo 1",)),
    ("albedo 1, 1e4 deep", "tau", {"tau": 1e4}, ("albedo 1", "optical depth")),
    ("albedo 1, 1e-8 deep", "albedo", {"tau": 1e-8}, ("albedo 1", "optical depth")),
    ("albedo 0", "albedo", {"albedo": 0.0}, ("R = T = 0",)),
)
# Photons estimate the second and third terms of the series; half of them go to and fro between plate and
# ground.
PLATE = family(
    "plate",
    ("a millimetre above the ground", "rho", {}, ("1 mm",)),
    ("by its transmittance", "T", {}, ("1 mm",)),
    ("half covering", "rho", {"coverage": 0.5}, ("1 mm",)),
    ("lossless over white ground", "R", {"R": 0.5, "T": 0.5, "rho": 1.0}, ("R + T = 1",)),
    ("black", "R", {"R": 0.0, "T": 0.0}, ("R = T = 0",), {"bounds": (1e-5, 1e-7)}),
    ("nowhere", "rho", {"coverage": 0.0}, ("empty",), {"bounds": (1e-5, 1e-7)}),
    ("10 m up", "rho", {"height": 10.0}, ()),
)

PROBABILITY = family(
    "probability",
    ("ordinary", "p_leaf", {}, ()),
    ("nothing", "p_leaf", {"p_leaf": 0.0}, ("p = 0",)),
    ("certain", "p_leaf", {"p_leaf": 1.0}, ("p = 1",)),
    ("nearly certain", "p_bark", {"p_bark": 1.0 - 2.0**-20}, ("p = 1",)),
    ("1e-8", "p_leaf", {"p_leaf": 1e-8, "p_bark": 0.0}, ("optical depth",)),
    ("by the edge", "edge", {"p_leaf": 1.0, "edge": 1e-3}, ("1 mm",)),
)
DIAGONAL = {"u": 3**-0.5, "v": 3**-0.5, "w": -(3**-0.5)}
EVEN = {"contrast": 0.0}
CHORD_ROWS = (
    ("askew", "k", {}, ()),
    ("askew, by height", "z", {"limit": 3.0}, ()),
    ("straight down", "k", {"u": 0.0, "v": 0.0, "w": -1.0}, ("axes",)),
    ("straight up", "contrast", {"u": 0.0, "v": 0.0, "w": 1.0, "z": -1.0}, ("axes",)),
    ("down the edges", "k", EVEN | {"u": 0.0, "v": 0.0, "w": -1.0, "x": 1.0, "y": 1.0}, ("axes", "faces")),
    ("through corners", "k", EVEN | DIAGONAL | {"x": 0.0, "y": 0.0, "z": 3.0}, ("corners",)),
    ("through corners, chequered", "contrast", DIAGONAL | {"x": 0.0, "y": 0.0, "z": 3.0}, ("corners",)),
    ("from a corner upwards", "k", EVEN | {"u": 3**-0.5, "v": 3**-0.5, "w": 3**-0.5, "z": 0.0}, ("corners",)),
    ("grazing", "k", {"u": 0.6, "v": 0.8, "w": -1e-3, "z": 1.5}, ("grazing",)),
    ("opaque", "k", {"k": 1e4}, ("optical depth",)),
    ("transparent", "k", {"k": 0.0}, ("p = 0",)),
    ("nearly transparent", "k", {"k": 1e-8}, ("optical depth",)),
    ("horizontal", "k", {"u": 1.0, "v": 0.0, "w": 0.0, "z": 1.5}, ("horizontal",)),
    ("horizontal, southwards", "contrast", {"u": 0.0, "v": -1.0, "w": 0.0, "z": 1.5}, ("horizontal",)),
    (
        "horizontal, within a face",
        "k",
        EVEN | {"u": 0.0, "v": 1.0, "w": 0.0, "x": 1.0, "z": 2.0},
        ("horizontal",),
    ),
    ("within a hair of horizontal", "k", {"u": 0.6, "v": 0.8, "w": 1e-7, "z": 1.5}, ("horizontal",)),
)
CHORD = family("chord", *CHORD_ROWS, ("past", "k", {"u": 0.0, "v": 0.0, "w": -1.0, "x": 5.0}, ("empty",)))
PERIODIC_CHORD = family(
    "endless chord",
    *CHORD_ROWS,
    (
        "horizontal, by how far",
        "limit",
        {"u": 1.0, "v": 0.0, "w": 0.0, "z": 1.5, "limit": 99.5},
        ("horizontal",),
    ),
    ("horizontal above the map", "k", {"u": 1.0, "v": 0.0, "w": 0.0, "z": 3.5}, ("horizontal", "empty")),
)
PURE = {"Cab": 0.0, "Car": 0.0, "Cant": 0.0, "Cbrown": 0.0, "Cw": 0.0, "Cm": 0.0}
FULL = {"N": 4.0, "Cab": 120.0, "Car": 30.0, "Cant": 10.0, "Cbrown": 2.0, "Cw": 0.1, "Cm": 0.05}
LEAF = family(
    "leaf",
    ("ordinary", "Cab", {}, ("table's ends",)),
    ("ordinary, by N", "N", {}, ("table's ends",)),
    *((f"one plate, by {name}", name, {"N": 1.0}, ("N = 1",)) for name in ("N", "Cw")),
    *((f"without absorption, by {name}", name, PURE, ("absorption 0",)) for name in ("N", "Cab", "Cw", "Cm")),
    ("one plate without absorption", "N", PURE | {"N": 1.0}, ("absorption 0", "N = 1")),
    ("one plate without absorption, by Car", "Car", PURE | {"N": 1.0}, ("absorption 0", "N = 1")),
    *((f"everything at its upper bound, by {name}", name, FULL, ("traits' bounds",)) for name in ("N", "Cw")),
)
AIR = family(
    "air",
    ("clear", "visibility", {}, ()),
    ("fog", "visibility", {"visibility": 0.5}, ("optical depth",)),
    ("impenetrable", "visibility", {"visibility": 1e-4}, ("optical depth",)),
    ("none to speak of", "visibility", {"visibility": 1e4}, ("optical depth",)),
    ("from 400 km", "height", {"altitude": 4e5}, ("400 km",)),
    ("from 400 km, by altitude", "altitude", {"altitude": 4e5}, ("400 km",)),
    ("target beside the sensor", "height", {"altitude": 1000.0, "height": 999.999}, ()),
    ("zenith of 89 degrees", "zenith", {"zenith": 89.0}, ("grazing",), {"bounds": (1e-4, 1e-12)}),
)
PULSES = family(
    "pulses",
    ("ordinary", "width", {}, ()),
    ("ordinary, by time", "shift", {}, ()),
    ("without jitter", "width", {"jitter": 0.0, "shift": 0.1}, ("jitter 0",)),
    ("without jitter, by it", "jitter", {"jitter": 0.0, "shift": 0.1}, ("jitter 0",)),
    ("without width", "shift", {"width": 0.0}, ("pulse of 0 ns",)),
    ("without width, by it", "width", {"width": 0.0}, ("pulse of 0 ns",)),
    (
        "without width or jitter",
        "shift",
        {"width": 0.0, "jitter": 0.0, "decay": 0.0},
        ("pulse of 0 ns",),
        KINK,
    ),
    ("without decay", "decay", {"decay": 0.0}, ("pulse of 0 ns",)),
    ("of 1 us", "width", {"width": 1000.0, "decay": 1000.0}, ("pulse of 1 us",)),
)

CASES = (
    *(*GROUND, *FINE, *SHORT, *EQUAL_ANGLE, *MIRROR),
    *(*SLAB, *HOT_SPOT, *SMALL, *LARGE, *CROWN, *FORTY_ORDERS, *PLATE),
    *(*PROBABILITY, *CHORD, *PERIODIC_CHORD, *LEAF, *AIR, *PULSES),
)

# By `str(case)`: the wrong result that was measured.
KNOWN_FAILURES: dict[str, str] = {}
