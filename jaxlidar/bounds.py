"""How much leaving out an effect changes, at most: cheap, by arguments that hold for every scene.

For one wavelength and one ray of the footprint: what meets material m, in the canopy with the density
k_m exp(-tau), scatters the share w_m of its energy and returns R_m v_m of it, v_m the view factor for
backscatter. Of a unit of energy that is met in the canopy at least R_m v_m / 2 returns, as the integral
of k exp(-2 tau) is at least half of that of k exp(-tau). What holds for every ray holds for the footprint: a
ratio of sums lies between the least and the largest ratio.

Taken as the same with and without an effect: the transmittance of the air within the depth of the scene.
"""

import numpy as np
from jaxtyping import Float

from ._checks import concrete
from .constants import SPEED_OF_LIGHT
from .extent import number, numbers
from .layout import Bins
from .letters import scene_optics
from .lidar import Lidar
from .materials import EqualAngle, Isotropic, Lambertian
from .scene import Canopy, Ground, Plate, Scene

Values = Float[np.ndarray, "wavelengths"]
# Cells of the pulse; more would add up the rounding of single precision.
_CELLS = 400


class Bounds:
    """Bounds on what each effect changes (see `jaxlidar.Effect`) in a scene simulated up to some order."""

    def __init__(self, lidar: Lidar, scene: Scene, orders: int):
        self.lidar, self.scene, self.orders = lidar, scene, orders
        self.slant = number(lidar.range_to_reference)
        self.half_angle = number(lidar.aperture_half_angle)
        self.axis = numbers(lidar.direction)
        self.rays, self.seen = self._footprint(number(lidar.footprint_radius))
        optics = {o.name: (o.reflectance, o.transmittance) for o in scene_optics(lidar, scene)}
        values = {k: (concrete(r), concrete(0.0 if t is None else t)) for k, (r, t) in optics.items()}
        names = [name for name in optics if name not in ("leaf", "bark")]
        self.surface = dict(zip(names, scene.surfaces))
        self.sheets = {n: s for n, s in self.surface.items() if isinstance(s, Plate)}
        # Optics that are being traced may have any value.
        self.known = all(r is not None and t is not None for r, t in values.values())
        self.optics = {k: (r, t + 0 * r) for k, (r, t) in values.items() if r is not None and t is not None}

    def _footprint(self, radius: float) -> tuple[Float[np.ndarray, "rays 3"], Float[np.ndarray, "rays"]]:
        """Directions of rays of equal energy, and how much of each the receiver sees."""
        u, turn = ((np.arange(n) + 0.5) / n for n in (64, 32))
        r = radius * (np.sqrt(-0.5 * np.log1p(-u)) if self.lidar.profile == "gaussian" else np.sqrt(u))
        first = np.cross(self.axis, [1.0, 0, 0] if abs(self.axis[0]) < 0.7 else [0, 1.0, 0])
        first /= np.linalg.norm(first)
        circle = np.outer(np.cos(2 * np.pi * turn), first)
        circle = circle + np.outer(np.sin(2 * np.pi * turn), np.cross(self.axis, first))
        rays = self.axis * self.slant + r[:, None, None] * circle
        seen = np.ones_like(r)
        if self.lidar.field_of_view is not None:
            edge = self.slant * number(self.lidar.field_of_view) * 0.5e-3
            seen = 1.0 / (1.0 + np.exp(np.clip((r / edge - 1.0) / 0.02, -80.0, 80.0)))
        rays = rays.reshape(-1, 3)
        return rays / np.linalg.norm(rays, axis=1)[:, None], np.repeat(seen, turn.size)

    # What materials do.

    def _backscatter(self, name: str) -> float:
        """View factor for backscatter along the axis; 0 where there is no lower bound."""
        canopy = self.scene.canopy
        if name in ("leaf", "bark"):
            assert canopy is not None
            if isinstance(canopy.leaf if name == "leaf" else canopy.bark, Isotropic):
                return 0.25
            if name == "leaf" and canopy.voxels.leaf_angles is not None:
                mean, square = (numbers(t) for t in canopy.voxels.leaf_angles.tables())
                place = abs(self.axis[2]) * (mean.size - 1)
                return float(np.interp(place, np.arange(mean.size), square / mean))
            return 2.0 / 3.0
        factor = self._facing(self.surface[name], self.axis[None, :])
        return 0.0 if factor is None else float(factor[0])

    def _brightest(self, name: str) -> float:
        """Largest view factor of what a material scatters."""
        canopy = self.scene.canopy
        if name in ("leaf", "bark"):
            assert canopy is not None
            if isinstance(canopy.leaf if name == "leaf" else canopy.bark, Isotropic):
                return 0.25
            return 1.0 if name == "leaf" and canopy.voxels.leaf_angles is not None else 2.0 / 3.0
        law = self.surface[name].law
        if isinstance(law, EqualAngle):
            return 2.0 / (np.pi * self.half_angle)
        return 1.0 if isinstance(law, Lambertian) else np.inf

    def _facing(
        self, surface: Ground | Plate, rays: Float[np.ndarray, "rays 3"]
    ) -> Float[np.ndarray, "rays"] | None:
        """View factors for backscatter of rays; None for a mirror."""
        cosine = np.abs(rays @ numbers(surface.plane.normal))
        if isinstance(surface.law, EqualAngle):
            return 1.0 / (np.pi * np.sqrt(1.0 - np.minimum(cosine, 1.0) ** 2 + self.half_angle**2 / 4))
        return cosine if isinstance(surface.law, Lambertian) else None

    def _sheet(self, name: str) -> tuple[Values, Values, Values]:
        """Shares of all light, whether it meets the plate or not, that are reflected, scattered, or go on."""
        plate, (r, t) = self.sheets[name], self.optics[name]
        cover, straight = number(plate.coverage), plate.transmission == "straight"
        return cover * r, cover * (r if straight else r + t), 1 - cover + cover * t * straight

    def _least_return(self, leave_out: str | None = None, dark: bool = True) -> Values:
        """First-order return of a unit of energy that is met by something, plates not counted.

        `dark`: whether light that ground without reflectance meets counts.
        """
        least = np.full(self.lidar.wavelength.size, np.inf)
        for name in ("leaf", "bark", "ground"):
            if name in self.optics and name != leave_out:
                r = self.optics[name][0]
                back = r * self._backscatter(name) * (1.0 if name == "ground" else 0.5)
                least = np.minimum(least, np.where((r > 0) | dark | (name != "ground"), back, np.inf))
        return least

    # Bounds by effect.

    def beyond(self, order: int) -> float:
        """Share of the sum that orders above `order` can have.

        What is scattered n + 1 times is at most s times what is scattered n times, s the largest share that a
        ray scatters of its energy, be it after passing plates. All of it returns with the largest view
        factor at most. What is scattered once is at most `ratio` times what returns of it.
        """
        if self.scene.canopy is None and len(self.scene.surfaces) <= 1:
            return 0.0
        if not self.known:
            return 1.0
        zero = np.zeros(self.lidar.wavelength.size)
        met = [np.sum(self.optics[n], axis=0) for n in ("leaf", "bark", "ground") if n in self.optics]
        most = np.max(met, axis=0) if met else zero
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(most > 0, most / self._least_return(dark=False), 0.0)
            s, passing = most, 1.0
            for name in self.sheets:
                reflected, scattered, through = self._sheet(name)
                ratio = np.maximum(ratio, scattered / (reflected * self._backscatter(name)))
                # The way back passes the plate once more; below an opaque one nothing is lit.
                passing = passing * np.where(through > 0, through, 1.0)
            # After any plate may come any other: as often as there are plates.
            for _ in self.sheets:
                s = np.max([s, *(self._onward(name, s) for name in self.sheets)], axis=0)
            brightest = max(map(self._brightest, self.optics), default=0.0)
            x = np.where(
                s > 0, brightest * s**order / (1.0 - s) * ratio / passing / (1.0 - self._outside()), 0.0
            )
            return _worst(1.0 / (1.0 + 1.0 / x))

    def _onward(self, name: str, after: Values) -> Values:
        """Share that a ray scatters at a plate, or where it went through and scatters `after` of the rest."""
        r, t = self.optics[name]
        return r + t * after if self.sheets[name].transmission == "straight" else r + t

    def multiple(self) -> float:
        """Share of the sum that the orders two and above which are simulated can have."""
        return self.beyond(1) if self.orders > 1 else 0.0

    def part(self, name: str) -> float:
        """Leaf or bark: shades what is there, by its depth along the beam, and returns light of its own.

        Where no ground is, there may be nothing else in view.
        """
        canopy = self.scene.canopy
        if canopy is None or not self.known or self.scene.ground is None or self.scene.plates:
            return 1.0
        kappa = 1.0 if canopy.hotspot else 2.0
        clear = np.exp(-kappa * self._depth(canopy, name))
        own = self.optics[name][0] * self._backscatter(name) * (1.0 - clear) / kappa
        rest = self._least_return(name) * clear
        return min(max(1.0 - float(clear), _worst(_share(own, rest))) + self.multiple(), 1.0)

    def plates(self) -> float:
        """Plates: shade what lies below by what goes straight through, both ways, and return light."""
        if not self.known or self.scene.ground is None:
            return 1.0
        own = np.zeros(self.lidar.wavelength.size)
        through = 1.0 + own
        for name in self.sheets:
            reflected, _, straight = self._sheet(name)
            factor = self._backscatter(name)
            if factor == 0.0:
                return 1.0
            own, through = own + reflected * factor, through * straight**2
        rest = self._least_return() * through
        return min(_worst(np.maximum(1.0 - through, _share(own, rest))) + self.multiple(), 1.0)

    def ground(self) -> float:
        """The ground: all may be its; below one plate, what goes through that beside what it returns."""
        if not self.known or self.scene.canopy is not None or len(self.sheets) != 1:
            return 1.0
        (name,) = self.sheets
        reflected, _, straight = self._sheet(name)
        below = self.optics["ground"][0] * straight**2
        if not isinstance(self.surface["ground"].law, Lambertian):
            return 1.0
        return min(_worst(_share(below, reflected * self._backscatter(name))) + self.multiple(), 1.0)

    def slope_spread(self, level: Ground) -> float:
        """Slope: every ray's delay and view factor beside those on level ground."""
        ground = self.scene.ground
        assert ground is not None
        # Rays differ by what canopy they pass, and the slope by how much of it.
        if self.scene.canopy is not None:
            return 1.0
        return min(self._change(ground, self.rays, level, self.rays) + self.multiple(), 1.0)

    def divergence(self) -> float:
        """Width of the beam: every ray's delay, view factor and place in view beside the axis's."""
        if self.scene.canopy is not None:
            return 1.0
        axis = np.broadcast_to(self.axis, self.rays.shape)
        worst = max((self._change(s, self.rays, s, axis) for s in self.scene.surfaces), default=0.0)
        return min(worst + self.multiple(), 1.0)

    def _change(
        self, one: Ground | Plate, rays: np.ndarray, other: Ground | Plate, others: np.ndarray
    ) -> float:
        """Bound on the samples' change as each ray is replaced by another.

        The absolute difference of two pulses a time d apart is, added up, at most twice `steepness` times d.
        """
        a, b = self._facing(one, rays), self._facing(other, others)
        if a is None or b is None:
            return 1.0
        a = a * self.seen
        b = b * (self.seen if one is not other else 1.0)
        apart = 2.0 * np.abs(self._distance(one, rays) - self._distance(other, others)) / SPEED_OF_LIGHT
        moved = np.where(apart > 0, np.minimum(self._steepness() * np.maximum(apart, 1e-30), 1.0), 0.0)
        change = np.sum(np.abs(a - b) + 2.0 * np.minimum(a, b) * moved)
        return float(min(change / max(np.sum(a + b), 1e-30), 1.0))

    def _distance(self, surface: Ground | Plate, rays: np.ndarray) -> np.ndarray:
        normal = numbers(surface.plane.normal)
        sensor = np.append(numbers(self.lidar.position), 0.0) - self.slant * self.axis
        towards = rays @ normal
        return (normal[2] * number(surface.plane.height) - normal @ sensor) / np.where(
            np.abs(towards) > 1e-9, towards, 1e-9
        )

    def _steepness(self) -> float:
        """Half the total variation of the pulse's power, 1/ns: of one with a single peak, the peak."""
        low, high = self.lidar.pulse.support(number(self.lidar.jitter))
        if not high > low:
            return np.inf
        power = np.diff(self._passed(low, high, number(self.lidar.jitter))) * _CELLS / (high - low)
        return 0.5 * float(np.sum(np.abs(np.diff(power, prepend=0.0, append=0.0))))

    def _passed(self, low: float, high: float, jitter: float) -> np.ndarray:
        return numbers(self.lidar.pulse.cumulative(np.linspace(low, high, _CELLS + 1), jitter))

    def jitter(self) -> float:
        """Jitter: every return's pulse beside the one without; sums of them differ by no larger share."""
        jitter = number(self.lidar.jitter)
        if jitter == 0.0:
            return 0.0
        low, high = self.lidar.pulse.support(jitter)
        with_, plain = (np.diff(self._passed(low, high, j)) for j in (jitter, 0.0))
        return min(0.5 * float(np.sum(np.abs(with_ - plain))), 1.0)

    def _outside(self) -> float:
        return 1.0 - float(np.mean(self.seen))

    def field_of_view(self) -> float:
        """What the footprint has outside, and of the higher orders, which spread, all."""
        return 0.0 if self.lidar.field_of_view is None else min(self._outside() + self.multiple(), 1.0)

    def hot_spot(self) -> float:
        """exp(-tau) of the way back, beside 1: at most 1 - exp(-tau) of every return of order one."""
        canopy = self.scene.canopy
        return 0.0 if canopy is None else 1.0 - float(np.exp(-self._depth(canopy)))

    def _depth(self, canopy: Canopy, name: str | None = None) -> float:
        """Optical depth along the beam, through the densest voxel of every layer."""
        v = canopy.voxels
        parts = [
            numbers(k) for n, k in (("leaf", v.leaf), ("bark", v.bark)) if k is not None and name in (None, n)
        ]
        per_metre = 1.0
        if v.leaf is not None and v.leaf_angles is not None and name != "bark":
            # The maps are for G = 1/2; of any direction it is at most 1.
            per_metre = 2.0
        steepest = float(np.min(np.abs(self.rays[:, 2])))
        layers = np.max(np.sum(parts, axis=0), axis=(0, 1)) * number(v.voxel_size[2])
        return per_metre * float(np.sum(layers)) / steepest

    def extinction(self, bins: Bins, upstream: float) -> float:
        """1 - two-way transmittance to the last bin; the air's own return goes with it."""
        return max(self.lost(bins), self.backscatter(bins, upstream))

    def lost(self, bins: Bins) -> float:
        """Share that the air takes of the light that goes farthest."""
        air = self.scene.atmosphere
        if air is None:
            return 0.0
        depth = air.two_way_transmittance(self.lidar.wavelength, self._heights(bins)[-1], *self._where())
        return 1.0 - float(np.min(numbers(depth)))

    def backscatter(self, bins: Bins, upstream: float) -> float:
        """The air's own return within the bins, beside the least return of the scene."""
        air = self.scene.atmosphere
        if air is None or air.lidar_ratio is None:
            return 0.0
        # Without ground, light may meet nothing; plates take a part that is not known here.
        if not self.known or self.scene.ground is None or self.scene.plates:
            return 1.0
        heights = self._heights(bins)
        per_metre = numbers(air.backscatter(self.lidar.wavelength, heights, *self._where()))
        above = heights > upstream * abs(self.axis[2])
        own = np.sum(np.where(above, per_metre, 0.0), axis=1) * 0.5 * SPEED_OF_LIGHT * bins.width
        rest = self._least_return() * (1.0 - self._outside()) * (1.0 - self.lost(bins))
        return _worst(_share(own, rest))

    def _heights(self, bins: Bins) -> np.ndarray:
        time = bins.start + bins.width * np.arange(bins.count)
        highest = 0.999 * number(self.lidar.altitude)
        return np.minimum(-0.5 * SPEED_OF_LIGHT * time * abs(self.axis[2]), highest)

    def _where(self) -> tuple[float, float]:
        return number(self.lidar.altitude), number(self.lidar.zenith)


def _share(part: Values, rest: Values) -> Values:
    return part / np.maximum(part + rest, 1e-30)


def _worst(share: Values) -> float:
    """The largest of all wavelengths; 1 where undefined."""
    return float(min(np.max(np.where(np.isnan(share), 1.0, share), initial=0.0), 1.0))
