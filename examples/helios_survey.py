"""Simulate a survey of HELIOS++. Run it as `python examples/helios_survey.py survey.xml --out a.laz`.

Survey, scene, scanner and platform are read as HELIOS++ states them, with OBJ, GeoTIFF, XYZ and .vox parts.
Waveforms are simulated, and returns have the number of the part that they hit, from 1, as their `instance`.
What is left out, or taken as something else, is printed. `--every 100` takes one pulse of a hundred.
"""

import argparse
import contextlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

import jaxlidar as jl

# Axes of HELIOS++ are right, forward and up; those of a body here forward, right and down.
TO_BODY = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
FORWARD = np.array([0.0, 1.0, 0.0])
# Reflectance of all parts: spectra of HELIOS++ are not read.
REFLECTANCE = 0.4
LOADERS = ("objloader", "geotiffloader", "xyzloader", "detailedvoxels")
# Most pulses of a leg: more is no survey, but a speed or a rate of another unit.
MAX_PULSES = 100_000_000


class Simulation(NamedTuple):
    """A survey, its scene, and what of the files is not mapped."""

    survey: jl.Survey
    scene: jl.Scene
    unmapped: tuple[str, ...]


class Beams(jl.AbstractScan):
    """Directions of all shots of a strip, forward, right and down."""

    rows: np.ndarray

    def direction(self, time: np.ndarray) -> np.ndarray:
        return self.rows


class Files:
    """XML files of a survey: elements by "file#id", and other files, beside the survey or above it."""

    def __init__(self, survey: Path):
        self.folders = [f / sub for f in survey.resolve().parents for sub in ("", "python/pyhelios")]
        self.unmapped: dict[str, None] = {}

    def path(self, name: str) -> Path:
        for folder in self.folders:
            if (folder / name).is_file():
                return folder / name
        raise FileNotFoundError(f"{name!r} lies neither beside the survey nor in a folder above it")

    def element(self, location: str, tag: str) -> ElementTree.Element:
        name, _, identifier = location.partition("#")
        for element in parsed(self.path(name)).iter(tag):
            if not identifier or element.get("id") == identifier:
                return element
        raise ValueError(f"{name} has no {tag} with id = {identifier!r}")

    def leave_out(self, what: str) -> None:
        self.unmapped[what] = None


def parsed(path: Path) -> ElementTree.Element:
    try:
        return ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{path}: no XML: {error}") from error


@contextlib.contextmanager
def named(path: Path) -> Iterator[None]:
    """Name the file in the errors of what is read from it."""
    try:
        yield
    except (ValueError, IndexError) as error:
        raise ValueError(f"{path}: {error}") from error


def number(
    element: ElementTree.Element | Mapping[str, str], name: str, default: float | None = None
) -> float:
    """Return an attribute as a number. **Raises:** ValueError, naming it, where it is none or missing."""
    text = element.get(name)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"{name} = {text!r}; admissible is a number")
    return value


def positive(
    element: ElementTree.Element | Mapping[str, str], name: str, default: float | None = None
) -> float:
    """Return an attribute as a number above 0. **Raises:** ValueError, naming it, where it is none."""
    value = number(element, name, default)
    if not value > 0.0:
        raise ValueError(f"{name} = {value:g}; admissible is a number above 0")
    return value


def vector(element: ElementTree.Element | None) -> np.ndarray:
    return np.array([0.0 if element is None else number(element, a, 0.0) for a in "xyz"])


def rotation(axis: Sequence[float], degrees: float | np.ndarray) -> np.ndarray:
    """Return right-handed rotation matrices about an axis (Rodrigues)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(np.asarray(degrees, float))[..., None, None]
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def rotations(element: ElementTree.Element | None) -> np.ndarray:
    """Return the product of the `rot` elements: about the axes of the world, or of the part that turns."""
    turn = np.eye(3)
    for rot in [] if element is None else element.findall("rot"):
        axis = str(rot.get("axis")).lower()
        if axis not in AXES:
            raise ValueError(f"rot has axis = {axis!r}; admissible are x, y and z")
        step = rotation(AXES[axis], number(rot, "angle_deg"))
        turn = turn @ step if element is not None and element.get("rotations") == "local" else step @ turn
    return turn


# -- scene -------------------------------------------------------------------------------------------------


def cubes(low: np.ndarray, edge: float) -> jl.Mesh:
    """Return cubes by their lowest corners."""
    corner = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([(q[0], q[k], q[k + 1]) for q in quads for k in (1, 2)])
    vertices = low[:, None] + edge * corner
    return jl.Mesh(vertices.reshape(-1, 3), (8 * np.arange(len(low))[:, None, None] + faces).reshape(-1, 3))


def cubes_of_voxels(path: Path) -> jl.Mesh:
    """Return the voxels that a .vox file lists as cubes, whatever their density."""
    lines = path.read_text().splitlines()
    head = {words[0]: words[1:] for line in lines if (words := line.lstrip("#").split()) and line[0] == "#"}
    first = next((n for n, line in enumerate(lines) if line.startswith("i ")), len(lines))
    if not {"min_corner:", "res:"} <= {*head} or first + 1 >= len(lines):
        raise ValueError(
            f"{path}: its head has no min_corner, res or columns i, j and k, or no voxel follows"
        )
    with named(path):
        edge, index = float(head["res:"][0]), np.loadtxt(lines[first + 1 :], usecols=(0, 1, 2), ndmin=2)
        return cubes(np.array(head["min_corner:"], float) + edge * index, edge)


class Part(NamedTuple):
    """A part of a scene: what its file holds, with the parameters of its filters by their types."""

    loader: str
    path: Path
    parameters: dict[str, dict[str, str]]
    turn: np.ndarray

    @property
    def scale(self) -> float:
        return number(self.parameters.get("scale", {}), "scale", 1.0)

    @property
    def offset(self) -> np.ndarray:
        text = self.parameters.get("translate", {}).get("offset", "0;0;0").split(";")
        if len(text) != 3:
            raise ValueError(f"offset = {text}; admissible are three numbers")
        return np.array([number({"offset": t}, "offset") for t in text])


def read_part(files: Files, element: ElementTree.Element) -> Part | None:
    filters = {str(f.get("type")): f for f in element.findall("filter")}
    parameters = {
        name: {str(p.get("key")): str(p.get("value")) for p in f.iter("param")} for name, f in filters.items()
    }
    loader = next((name for name in filters if name in LOADERS), None)
    for name in sorted({*filters} - {loader, "scale", "rotate", "translate"}):
        files.leave_out(f"filter {name!r} of a part")
    for tag in sorted({child.tag for child in element} - {"filter"}):
        files.leave_out(f"{tag!r} of a part: it stays as it is")
    if loader is None:
        files.leave_out("a part without " + ", ".join(LOADERS))
        return None
    turns = [] if "rotate" not in filters else filters["rotate"].findall("param")
    turn = rotations(turns[0]) if turns else np.eye(3)
    name = parameters[loader].get("filepath", "")
    try:
        return Part(loader, files.path(name), parameters, turn)
    except FileNotFoundError:
        files.leave_out(f"the part {name!r}, whose file is missing")
        return None


def mesh_of_part(part: Part, n: int) -> jl.Mesh:
    """Return the triangles of part number n, in the coordinates of the scene."""
    options = part.parameters[part.loader]
    if part.loader == "xyzloader":
        separator = options.get("separator", " ")
        layout = {"delimiter": separator.strip() or None, "comments": ("#", "//")}
        edge = positive(options, "voxelSize")
        with named(part.path):
            points = np.loadtxt(part.path, **layout, usecols=(0, 1, 2), ndmin=2)
            mesh = cubes(np.unique(np.floor(points / edge), axis=0) * edge, edge)
    elif part.loader == "detailedvoxels":
        mesh = cubes_of_voxels(part.path)
    else:
        mesh = jl.io.read_mesh(part.path, up=options.get("up", "z"), scale=1.0).mesh
    vertices = (part.scale * mesh.vertices) @ part.turn.T + part.offset
    return jl.Mesh(vertices, mesh.faces, instance=np.full(len(mesh.faces), n))


def height_on_meshes(meshes: Sequence[jl.Mesh], place: np.ndarray) -> float:
    """Return the height of the lowest triangle at x and y, m; 0 where there is none."""
    heights = [0.0] * (not meshes)
    for a, b, c in (np.moveaxis(mesh.corners, 1, 0) for mesh in meshes):
        (u, v, w), (p, q, r) = ((d - a).T for d in (b, c))
        x, y = place[0] - a[:, 0], place[1] - a[:, 1]
        area = u * q - v * p
        # Triangles on edge, as seen from above, have no height there.
        area = np.where(area == 0.0, np.nan, area)
        f, g = (x * q - y * p) / area, (y * u - x * v) / area
        heights.extend((a[:, 2] + f * w + g * r)[(f >= 0) & (g >= 0) & (f + g <= 1)])
    return min(heights, default=0.0)


def read_scene(files: Files, location: str) -> tuple[jl.Scene, Callable[[np.ndarray], float]]:
    """Return the scene, and the height of its ground as a function of place."""
    meshes: list[jl.Mesh] = []
    surfaces, maps, terrain = [], [], None

    def height(place: np.ndarray) -> float:
        if terrain is None:
            return height_on_meshes(meshes, place)
        return float(np.asarray(terrain.height_at(place[:1], place[1:2]))[0])

    for n, element in enumerate(files.element(location, "scene").findall("part"), 1):
        part = read_part(files, element)
        if part is None:
            continue
        options = part.parameters[part.loader]
        if part.loader == "geotiffloader":
            terrain = jl.io.read_dem(part.path).terrain
        elif part.loader == "detailedvoxels" and options.get("intersectionMode") in (None, "transmittive"):
            voxels = jl.io.read_vox(part.path).voxels
            maps.append(eqx.tree_at(lambda v: v.origin, voxels, voxels.origin + part.offset))
        else:
            if options.get("intersectionMode") == "scaled":
                files.leave_out("the sizes of voxels of the mode 'scaled': they are whole cubes")
            mesh = mesh_of_part(part, n)
            if number(part.parameters.get("translate", {}), "onGround", 0):
                rise = height(mesh.vertices.mean(axis=0)) - mesh.vertices[:, 2].min()
                vertices = mesh.vertices + np.array([0.0, 0.0, rise])
                mesh = jl.Mesh(vertices, mesh.faces, instance=mesh.instance)
            meshes.append(mesh)
            surfaces.append(jl.MeshSurface(mesh, reflectance=REFLECTANCE))
    files.leave_out(f"materials: the reflectance of all parts is {REFLECTANCE:g}")
    canopy = jl.Canopy(jl.VoxelMap.join(maps), leaf=jl.Prospect()) if maps else None
    return jl.Scene(canopy=canopy, ground=terrain, meshes=surfaces), height


# -- survey ------------------------------------------------------------------------------------------------


def deflections(scanner: ElementTree.Element, settings: Mapping[str, str], time: np.ndarray) -> np.ndarray:
    """Return the directions of the deflector's beam, right, forward and up; NaN where it sends no pulse."""
    optics, largest = scanner.get("optics"), number(scanner, "scanAngleMax_deg", 180.0)
    angle = min(number(settings, "scanAngle_deg", 0.0) or largest, largest)
    frequency = number(settings, "scanFreq_hz", 0.0)
    if optics == "rotating":
        # The mirror turns through all of its range; pulses leave within the effective one.
        limit = min(number(scanner, "scanAngleEffectiveMax_deg", largest), angle)
        low = number(settings, "verticalAngleMin_deg", -limit)
        high = number(settings, "verticalAngleMax_deg", limit)
        turn = (2.0 * largest * frequency * time + largest) % (2.0 * largest) - largest
        return rotation(AXES["x"], np.where((turn >= low) & (turn <= high), turn, np.nan)) @ FORWARD
    if optics == "oscillating":
        wave = 1.0 - np.abs((4.0 * frequency * time + 1.0) % 4.0 - 2.0)
        return rotation(AXES["x"], angle * wave) @ FORWARD
    if optics == "conic":
        turn = 360.0 * number(scanner, "scanFreqMax_Hz") * time
        return rotation(AXES["y"], turn) @ (rotation(AXES["x"], angle) @ FORWARD)
    if optics == "risley":
        prisms = [k for k in (1, 2, 3) if number(scanner, f"angle{k}_deg", 0.0)]
        names = ("angle{}_deg", "rotorFreq{}_Hz", "refrIndex{}")
        wedge, turns, index = ([number(scanner, name.format(k)) for k in prisms] for name in names)
        # About straight down there, and ahead here.
        first, second, along = jl.Risley(wedge, turns, index).direction(time).T
        return np.stack([second, along, first], axis=1)
    raise ValueError(
        f"scanner has optics = {optics!r}; admissible are rotating, oscillating, conic and risley"
    )


def read_lidar(scanner: ElementTree.Element, rate: float) -> jl.Lidar:
    return jl.Lidar(
        wavelength=number(scanner, "wavelength_nm", 1064.0),
        divergence=1e3 * number(scanner, "beamDivergence_rad", 0.0003),
        aperture=number(scanner, "receiverDiameter_m", 0.15),
        energy=number(scanner, "averagePower_w", 4.0) / rate,
        efficiency=number(scanner, "opticalEfficiency", 0.99),
        pulse=jl.GaussianPulse(fwhm=number(scanner, "pulseLength_ns", 4.0)),
        sampling_interval=0.5,
        sensor=(0.0, 0.0, 0.0),
    )


def legs_of(root: ElementTree.Element, scanner: ElementTree.Element) -> list[dict[str, str]]:
    """Return the attributes of all legs, their platforms and scanner settings, over those of templates."""
    rates = (scanner.get("pulseFreqs_Hz") or "").split(",")
    legs = []
    for leg in root.iter("leg"):
        settings = {"pulseFreq_hz": rates[0], **leg.attrib}
        for tag in ("platformSettings", "scannerSettings"):
            own = leg.find(tag)
            name = None if own is None else own.get("template")
            templates = [e for e in root.iter(tag) if name is not None and e.get("id") == name]
            for element in (*templates[:1], *(() if own is None else (own,))):
                settings |= element.attrib
        resolution = [number(settings, f"{way}Resolution_deg", 0.0) for way in ("vertical", "horizontal")]
        if all(resolution):
            largest = 2.0 * positive(scanner, "scanAngleMax_deg")
            lines = resolution[0] * number(settings, "pulseFreq_hz") / largest
            settings |= {"scanFreq_hz": str(lines), "headRotatePerSec_deg": str(resolution[1] * lines)}
        legs.append(settings)
    return legs


def read_survey(path: Path, every: int = 1) -> Simulation:
    """Read a survey of HELIOS++, with one of `every` pulses."""
    files, root = Files(path), parsed(path)
    survey = root.find("survey")
    if survey is None:
        raise ValueError(f"{path} has no survey")
    if survey.get("platform") == "interpolated" or root.find(".//platformSettings[@trajectory]") is not None:
        raise ValueError(f"{path}: a platform that follows a file is not mapped; admissible are legs")
    scene, height = read_scene(files, survey.get("scene", ""))
    carrier = files.element(survey.get("platform", ""), "platform")
    scanner = files.element(survey.get("scanner", ""), "scanner")
    is_static, mount = carrier.get("type") == "static", carrier.find("scannerMount")
    if carrier.get("type") not in ("static", "linearpath"):
        files.leave_out(f"the dynamics of a {carrier.get('type')}: it moves straight from leg to leg")
    if scanner.find("channels") is not None:
        files.leave_out("further channels of the scanner: its first one flies alone")
    for tag in ("detectorSettings", "FWFSettings"):
        if survey.find(tag) is not None:
            files.leave_out(f"{tag}: waveforms and detection are those of jaxlidar")
    channel = scanner.find("channels/channel/beamOrigin")
    origin = scanner.find("beamOrigin") if channel is None else channel
    turn, emitter = rotations(mount), rotations(origin)
    arm = TO_BODY @ (vector(mount) + turn @ vector(origin))
    legs, strips, start = legs_of(root, scanner), [], 0.0
    lidar = read_lidar(scanner, positive(legs[0], "pulseFreq_hz")) if legs else jl.Lidar()
    places = [np.array([number(leg, a, 0.0) for a in "xyz"]) for leg in legs]
    for place, leg in zip(places, legs):
        if leg.get("onGround") in ("true", "1", "-1"):
            place[2] = height(place)
    for k, leg in enumerate(legs):
        head, stop, speed = (number(leg, f"headRotate{w}_deg", 0.0) for w in ("Start", "Stop", "PerSec"))
        way = places[min(k + 1, len(legs) - 1)] - places[k] if not is_static else np.zeros(3)
        duration = np.linalg.norm(way) / positive(leg, "movePerSec_m", 70.0) if way.any() else 0.0
        if is_static:
            duration = number(leg, "maxDuration_s", abs(stop - head) / abs(speed) if speed else 0.0)
        if leg.get("active") == "false" or duration == 0.0:
            continue
        interval = every / positive(leg, "pulseFreq_hz")
        if duration > MAX_PULSES * interval:
            raise ValueError(
                f"leg {k + 1} sends {duration / interval:.3g} pulses; admissible are {MAX_PULSES:,}: "
                f"take one of more than every = {every}"
            )
        time = np.arange(0.0, duration, interval)
        beam = deflections(scanner, leg, time) @ emitter.T
        beam = np.einsum("sij,sj->si", turn @ rotation(AXES["z"], head + speed * time), beam) @ TO_BODY.T
        (sent,) = np.nonzero(np.isfinite(beam[:, 0]))
        if not sent.size:
            raise ValueError(f"leg {k + 1} sends no pulse; admissible is a smaller value of every = {every}")
        position = places[k] + time[sent, None] / duration * way
        flight = jl.Trajectory(start + time[sent], position, yaw=0.0 if is_static else None)
        strip = jl.Survey.fly(flight, Beams(beam[sent]), lidar=lidar, lever_arm=arm)
        strips.append(eqx.tree_at(lambda s: s.flight_line, strip, np.full(len(strip), k + 1)))
        start += duration
    if not strips:
        raise ValueError(f"{path} has no leg that scans")
    return Simulation(jl.Survey.join(strips), scene, tuple(files.unmapped))


def main(arguments: Sequence[str] | None = None) -> jl.DiscreteReturns:
    """Read the survey, simulate it, print what is not mapped, and write and return the discrete returns."""
    parser = argparse.ArgumentParser(description="Simulate a survey of HELIOS++.")
    parser.add_argument("survey", type=Path, help="XML file of the survey")
    parser.add_argument("--every", type=int, default=1, help="take one pulse of so many")
    parser.add_argument("--out", type=Path, help="LAS or LAZ file of the labelled returns")
    options = parser.parse_args(arguments)
    survey, scene, unmapped = read_survey(options.survey, options.every)
    print(survey, *(f"not mapped: {what}" for what in unmapped), sep="\n")
    many = jl.simulate_many(survey, scene, key=jax.random.key(0), rtol=0.1, max_orders=1, beyond="miss")
    returns = many.returns(max_returns=15).labelled(survey, scene)
    print(returns)
    if options.out is not None:
        returns.to_las(options.out)
    return returns


if __name__ == "__main__":
    main()
