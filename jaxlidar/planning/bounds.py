"""Upper bounds on what leaving out an effect changes: cheap to compute, and valid for every scene.

Within a canopy the return of order one is the integral of k R v exp(-kappa tau), with kappa 2 or, with the
hot spot, 1. So what one ray returns is a weighted mean of R v / kappa of leaf and bark and R v of the ground,
with weights that add up to one; R is the reflectance and v the intensity factor of backscatter. What holds
for every ray holds for the footprint: a ratio of sums lies between the least and the largest ratio.

The transmittance of the air within the depth of the scene is taken to be the same with and without an effect.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxlidar._checks import concrete_array, concrete_number
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._vectors import vec
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.optics.facets import FACET_BACKSCATTER
from jaxlidar.optics.laws import AbstractMirror
from jaxlidar.planning.backscatter import PerRay, Rays, backscatter, footprint_rays
from jaxlidar.planning.channels import scene_optics
from jaxlidar.planning.config import TimeBins
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import AbstractSheet, AbstractSurface

Values = Float[np.ndarray, "wavelengths"]
# Cells of the pulse; more would add up the rounding of single precision.
_CELLS = 400
# A mirror's intensity factor is as large as its lobe is narrow.
_MIRROR = 1e30


class Bounds:
    """Bounds on what each effect changes (see `jaxlidar.Effect`) in a scene simulated up to a given order."""

    def __init__(self, lidar: Lidar, scene: Scene, orders: int):
        self.lidar, self.scene, self.orders = lidar, scene, orders
        self.slant = concrete_number(lidar.range_to_reference)
        self.half_angle = concrete_number(lidar.aperture_half_angle)
        self.axis = concrete_array(lidar.direction)
        self.rays, self.seen = footprint_rays(lidar)
        self.outside = 1.0 - float(np.mean(self.seen))
        optics = scene_optics(lidar, scene)
        zero = np.zeros(lidar.wavelength.size)
        self.optics = {
            o.name: (
                concrete_array(o.reflectance),
                zero if o.transmittance is None else concrete_array(o.transmittance),
            )
            for o in optics
        }
        self.surface = dict(zip([n for n in self.optics if n not in ("leaf", "bark")], scene.surfaces))
        self.sheets = {n: s for n, s in self.surface.items() if isinstance(s, AbstractSheet)}
        self.kappa = 1.0 if scene.canopy is not None and scene.canopy.hotspot else 2.0

    # What materials do.

    def _factors(self, name: str) -> tuple[float, float]:
        """Least and largest intensity factor for backscatter, of all rays."""
        canopy = self.scene.canopy
        if name not in ("leaf", "bark"):
            factor = self._facing(self.surface[name], self.rays)
            return (0.0, _MIRROR) if factor is None else (float(factor.min()), float(factor.max()))
        assert canopy is not None
        phase = canopy.leaf_phase if name == "leaf" else canopy.bark_phase
        if phase is not None:
            factor = backscatter(phase, self.rays)
            return float(factor.min()), float(factor.max())
        if name == "leaf" and canopy.voxels.leaf_angles is not None:
            mean, square = (concrete_array(t) for t in canopy.voxels.leaf_angles.tables())
            found = np.interp(np.abs(self.rays[:, 2]), np.linspace(0, 1, mean.size), square / mean)
            return float(found.min()), float(found.max())
        return FACET_BACKSCATTER, FACET_BACKSCATTER

    def _brightest(self, name: str) -> float:
        """Largest intensity factor of what a material scatters, for any two directions."""
        canopy = self.scene.canopy
        if name not in ("leaf", "bark"):
            return self.surface[name].law.largest_intensity_factor(self.half_angle)
        assert canopy is not None
        phase = canopy.leaf_phase if name == "leaf" else canopy.bark_phase
        if phase is not None:
            return phase.largest_intensity_factor()
        # Spherically oriented facets are brightest straight back.
        return 1.0 if name == "leaf" and canopy.voxels.leaf_angles is not None else FACET_BACKSCATTER

    def _facing(self, surface: AbstractSurface, rays: Rays) -> PerRay | None:
        """Intensity factors of rays for backscatter, zero from under the ground; None for a mirror."""
        if isinstance(surface.law, AbstractMirror):
            return None
        normal, _ = surface.shape.tangent(vec(jnp.zeros(3)))
        upward = np.stack([concrete_array(n) for n in normal])
        return backscatter(surface.law, rays, upward, self.half_angle, isinstance(surface, AbstractSheet))

    def _sheet(self, name: str) -> tuple[Values, Values, Values]:
        """Shares of all light, whether it meets the plate or not: reflected, scattered, passed straight."""
        plate, (r, t) = self.sheets[name], self.optics[name]
        cover, straight = concrete_number(plate.coverage), plate.transmission == "straight"
        return cover * r, cover * (r if straight else r + t), 1 - cover + cover * t * straight

    def _returns(self, leave_out: str | None = None) -> tuple[Values, Values]:
        """Least and largest return of order one of a ray, without plates.

        Where there is no ground, a ray may meet nothing.
        """
        least = np.full(self.lidar.wavelength.size, np.inf)
        most = np.zeros_like(least)
        for name in ("leaf", "bark", "ground"):
            if name in self.optics and name != leave_out:
                r = self.optics[name][0] / (1.0 if name == "ground" else self.kappa)
                low, high = self._factors(name)
                least, most = np.minimum(least, r * low), np.maximum(most, r * high)
        return (least if self.scene.ground is not None else np.zeros_like(least)), most

    def _through(self) -> Values:
        """Share that meets no plate or goes straight through all plates, one way."""
        return np.prod([np.ones(self.lidar.wavelength.size), *(self._sheet(n)[2] for n in self.sheets)], 0)

    def _from_plates(self) -> Values:
        """Largest return of order one of all plates together."""
        own = [self._sheet(n)[0] * self._factors(n)[1] for n in self.sheets]
        return np.sum([np.zeros(self.lidar.wavelength.size), *own], axis=0)

    # Bounds by effect.

    def beyond(self, order: int) -> float:
        """Largest share of the sum that orders above `order` can have.

        What is scattered n + 1 times is at most s times what is scattered n times. s is the largest share
        that a ray scatters of its energy, also after passing plates; between two planes, what one of them
        scatters meets the other. All of it returns with the largest intensity factor at most.
        """
        if self.scene.canopy is None and len(self.scene.surfaces) <= 1:
            return 0.0
        brightest = max(map(self._brightest, self.optics), default=0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = self._between(order) if self._is_plate_over_ground() else self._among(order)
            x = brightest * share
            return _worst(np.where(share > 0, 1.0 / (1.0 + 1.0 / x), 0.0))

    def _between(self, order: int) -> Values:
        """What a plate and the ground scatter between them above `order`, per return of order one."""
        (name,), (r, _) = self.sheets, self.optics["ground"]
        reflected, scattered, through = self._sheet(name)
        returned = reflected * self._factors(name)[0] + through**2 * r * self._factors("ground")[0]
        plate, ground = scattered, through * r
        for _ in range(order):
            plate, ground = scattered * ground, r * plate
        every_other = plate + ground + scattered * ground + r * plate
        return every_other / (1.0 - r * scattered) / (returned * (1.0 - self.outside))

    def _among(self, order: int) -> Values:
        """What anything scatters above `order`, per return of order one.

        What is scattered once is at most `ratio` times what of it returns, plus what is outside the field of
        view.
        """
        s, passing = np.zeros(self.lidar.wavelength.size), 1.0
        for name, (r, t) in self.optics.items():
            if name not in self.sheets:
                s = np.maximum(s, r + t)
        ratio = self._scattered_per_return()
        for name in self.sheets:
            reflected, scattered, through = self._sheet(name)
            own = scattered / (reflected * self._factors(name)[0])
            ratio = np.maximum(ratio, np.where(scattered > 0, own, 0.0))
            # The way back passes the plate once more; below an opaque one nothing is lit.
            passing = passing * np.where(through > 0, through, 1.0)
        # After any plate may come any other: as often as there are plates.
        for _ in self.sheets:
            s = np.max([s, *(self._onward(name, s) for name in self.sheets)], axis=0)
        unseen = np.zeros_like(s)
        if self.outside > 0:
            floor = self._returns()[0] * self._through() ** 2 * (1.0 - self.outside)
            unseen = s * self.outside / floor
        return np.where(s > 0, s**order / (1.0 - s) * (ratio / passing + unseen), 0.0)

    def _scattered_per_return(self) -> Values:
        """Largest ratio of what canopy and ground scatter of a ray to what of it returns, without plates.

        Where the share x of a ray passes the canopy, the canopy scatters 1 - x and returns (1 - x^kappa) /
        kappa. The ray may also end before the ground.
        """
        canopy = self.scene.canopy
        x = np.linspace(1.0 if canopy is None else np.exp(-self._depth(canopy)), 1.0, 201)[:, None]
        scattered = returned = ratio = np.zeros((x.size, self.lidar.wavelength.size))
        met = [n for n in ("leaf", "bark") if n in self.optics]
        if met:
            scattered = (1.0 - x) * np.max([np.sum(self.optics[n], axis=0) for n in met], axis=0)
            least = np.min([self.optics[n][0] * self._factors(n)[0] for n in met], axis=0)
            returned = (1.0 - x**self.kappa) / self.kappa * least
            ratio = np.where(scattered > 0, scattered / returned, 0.0)
        if "ground" in self.optics:
            r = self.optics["ground"][0]
            scattered, returned = scattered + x * r, returned + x**self.kappa * r * self._factors("ground")[0]
            ratio = np.maximum(ratio, np.where(scattered > 0, scattered / returned, 0.0))
        return np.max(ratio, axis=0)

    def _onward(self, name: str, after: Values) -> Values:
        """Share of a ray that a plate scatters, or passes on to where the share `after` is scattered."""
        _, scattered, through = self._sheet(name)
        return scattered + through * after

    def _with_orders(self, first: float) -> float:
        """The bound for all orders: `first` bounds the change of order one, all of the others may change."""
        higher = self.beyond(1) if self.orders > 1 else 0.0
        return 1.0 - (1.0 - first) * (1.0 - higher)

    def part(self, name: str) -> float:
        """Leaf or bark: shades all else, by its depth along the beam, and returns light of its own.

        Where there is no ground, nothing else may be in view.
        """
        canopy = self.scene.canopy
        if canopy is None or self.scene.ground is None or self.scene.plates:
            return 1.0
        clear = np.exp(-self.kappa * self._depth(canopy, name))
        own = self.optics[name][0] * self._factors(name)[1] * (1.0 - clear) / self.kappa
        rest = self._returns(name)[0] * clear
        return self._with_orders(max(1.0 - float(clear), _worst(_share(own, rest))))

    def plates(self) -> float:
        """Plates: shade what lies below by what goes straight through, both ways, and return light."""
        clear = self._through() ** 2
        (least, most), own = self._returns(), self._from_plates()
        if self._is_plate_over_ground():
            (name,) = self.sheets
            sure = self._sheet(name)[0] * self._factors(name)[0]
            darker = 1.0 - clear - sure / np.maximum(most, 1e-30)
            brighter = (own - (1.0 - clear) * least) / np.maximum(own + clear * least, 1e-30)
        else:
            # What some rays meet may lie before the plates.
            darker, brighter = 1.0 - clear, _share(own, clear * least)
        return self._with_orders(_worst(np.maximum(np.maximum(darker, brighter), 0.0)))

    def ground(self) -> float:
        """The ground: up to the whole return; below one plate, its return through that beside the plate's."""
        if not self._is_plate_over_ground():
            return 1.0
        (name,) = self.sheets
        reflected, _, straight = self._sheet(name)
        below = self._returns()[1] * straight**2
        return self._with_orders(_worst(_share(below, reflected * self._factors(name)[0])))

    def _is_plate_over_ground(self) -> bool:
        """Whether there is nothing but one plate that every ray meets before the ground."""
        if self.scene.canopy is not None or self.scene.ground is None or len(self.scene.plates) != 1:
            return False
        below, above = (self._distance(s, self.rays) for s in self.scene.surfaces)
        return bool(np.all(above > 0) and np.all(above < below))

    def slope_spread(self, level: "Bounds") -> float:
        """Slope: delay and intensity factor of every ray, compared with those on level ground (`level`)."""
        one, other, canopy = self.scene.ground, level.scene.ground, self.scene.canopy
        assert one is not None
        assert other is not None
        if not (self._ordered() and level._ordered()):
            return 1.0
        if canopy is not None:
            # Rays reach the ground by different shares, which change where it lies within the canopy.
            reached = np.minimum(self._distance(one, self.rays), self._distance(other, self.rays))
            if np.any(reached < self._lowest(canopy)):
                return 1.0
        change = self._change(one, self.rays, other, self.rays, self.seen, canopy is not None)
        return max(self._with_orders(change), level._with_orders(change))

    def divergence(self) -> float:
        """Width of the beam: delay, intensity factor and share seen of every ray, beside the axis's."""
        if self.scene.canopy is not None or not self._ordered():
            return 1.0
        axis, seen = np.broadcast_to(self.axis, self.rays.shape), np.ones_like(self.seen)
        worst = (self._change(s, self.rays, s, axis, seen, False) for s in self.scene.surfaces)
        return self._with_orders(max(worst, default=0.0))

    def _ordered(self) -> bool:
        """Whether all rays meet the surfaces in the same order; then these shade each other equally."""
        distances = [self._distance(s, self.rays) for s in self.scene.surfaces]
        order = np.argsort(distances, axis=0) if distances else np.zeros((0, 1))
        return bool(np.all(order == order[:, :1]))

    def _lowest(self, canopy: Canopy) -> PerRay:
        """Distance along rays to the bottom of the lowest layer that is not empty."""
        empty = np.argmax(self._layers(canopy) > 0)
        layer = concrete_number(canopy.voxels.voxel_size[2])
        bottom = concrete_array(canopy.voxels.origin)[2] + layer * empty
        return (bottom - concrete_number(self.lidar.altitude)) / self.rays[:, 2]

    def _change(
        self,
        one: AbstractSurface,
        rays: Rays,
        other: AbstractSurface,
        others: Rays,
        seen: PerRay,
        uneven: bool,
    ) -> float:
        """Bound on the samples' change as each ray is replaced by another, seen by the share `seen`.

        The absolute difference of two pulses a time d apart is, added up, at most twice `steepness` times d.
        Where rays have uneven energies, the ray that changes most counts.
        """
        a, b = self._facing(one, rays), self._facing(other, others)
        if a is None or b is None:
            return 1.0
        a, b = a * self.seen, b * seen
        apart = 2.0 * np.abs(self._distance(one, rays) - self._distance(other, others)) / SPEED_OF_LIGHT
        moved = np.where(apart > 0, np.minimum(self._steepness() * np.maximum(apart, 1e-30), 1.0), 0.0)
        change, both = np.abs(a - b) + 2.0 * np.minimum(a, b) * moved, a + b
        if uneven:
            return float(np.max(change / np.maximum(both, 1e-30)))
        return float(np.sum(change) / max(np.sum(both), 1e-30))

    def _distance(self, surface: AbstractSurface, rays: Rays) -> PerRay:
        sensor = np.append(concrete_array(self.lidar.position), 0.0) - self.slant * self.axis
        return surface.shape.crossing(np.broadcast_to(sensor, rays.shape), rays)[0]

    def _steepness(self) -> float:
        """Half the total variation of the pulse's power, 1/ns; with a single peak this is the peak."""
        low, high = self.lidar.pulse.support(concrete_number(self.lidar.jitter))
        if not high > low:
            return np.inf
        power = np.diff(self._passed(low, high, concrete_number(self.lidar.jitter))) * _CELLS / (high - low)
        return 0.5 * float(np.sum(np.abs(np.diff(power, prepend=0.0, append=0.0))))

    def _passed(self, low: float, high: float, jitter: float) -> np.ndarray:
        return concrete_array(self.lidar.pulse.cumulative(np.linspace(low, high, _CELLS + 1), jitter))

    def jitter(self) -> float:
        """Jitter: one return's pulse with it and without it; sums of pulses differ by no larger share."""
        jitter = concrete_number(self.lidar.jitter)
        low, high = self.lidar.pulse.support(jitter)
        with_, plain = (np.diff(self._passed(low, high, j)) for j in (jitter, 0.0))
        return min(0.5 * float(np.sum(np.abs(with_ - plain))), 1.0)

    def field_of_view(self) -> float:
        """Field of view: the brightest that the footprint may be outside it, beside the darkest inside."""
        if self.scene.canopy is None and len(self.scene.surfaces) == 1:
            (surface,) = self.scene.surfaces
            factor = self._facing(surface, self.rays)
            if factor is None:
                return 1.0
            return float(np.sum(factor * (1.0 - self.seen)) / max(np.sum(factor), 1e-30))
        least, most = self._returns()
        most, least = most + self._from_plates(), least * self._through() ** 2
        return self._with_orders(_worst(_share(most * self.outside, least * (1.0 - self.outside))))

    def hot_spot(self) -> float:
        """Hot spot: of every return of order one, at most 1 - exp(-tau), tau the depth of the way back."""
        canopy = self.scene.canopy
        return 0.0 if canopy is None else 1.0 - float(np.exp(-self._depth(canopy)))

    def _layers(self, canopy: Canopy, name: str | None = None) -> Float[np.ndarray, "layers"]:
        """Extinction, 1/m, of the densest voxel of every layer."""
        v = canopy.voxels
        parts = [
            concrete_array(k)
            for n, k in (("leaf", v.leaf), ("bark", v.bark))
            if k is not None and name in (None, n)
        ]
        # The maps are for G = 1/2; of any leaf angles and direction it is at most 1.
        least = 1.0 if v.leaf is None or v.leaf_angles is None or name == "bark" else 2.0
        return least * np.max(np.sum(parts, axis=0), axis=(0, 1))

    def _depth(self, canopy: Canopy, name: str | None = None) -> float:
        """Largest optical depth along any ray."""
        steepest = float(np.min(np.abs(self.rays[:, 2])))
        layer = concrete_number(canopy.voxels.voxel_size[2])
        return float(np.sum(self._layers(canopy, name))) * layer / steepest

    def extinction(self, bins: TimeBins, start_distance: float) -> float:
        """Extinction, two-way, to the last bin; without it the air's own return is left out too."""
        return max(self.lost(bins), self.backscatter(bins, start_distance))

    def lost(self, bins: TimeBins) -> float:
        """Share that the air takes of the light with the longest way."""
        air = self.scene.atmosphere
        if air is None:
            return 0.0
        depth = air.two_way_transmittance(self.lidar.wavelength, self._heights(bins)[-1], *self._where())
        return 1.0 - float(np.min(concrete_array(depth)))

    def backscatter(self, bins: TimeBins, start_distance: float) -> float:
        """The air's own return within the bins, relative to it and the least return of the scene."""
        air = self.scene.atmosphere
        if air is None or air.lidar_ratio is None:
            return 0.0
        heights = self._heights(bins)
        per_metre = concrete_array(air.backscatter(self.lidar.wavelength, heights, *self._where()))
        above = heights > start_distance * abs(self.axis[2])
        own = np.sum(np.where(above, per_metre, 0.0), axis=1) * 0.5 * SPEED_OF_LIGHT * bins.width
        rest = self._returns()[0] * self._through() ** 2 * (1.0 - self.outside) * (1.0 - self.lost(bins))
        return _worst(_share(own, rest))

    def _heights(self, bins: TimeBins) -> np.ndarray:
        time = bins.start + bins.width * np.arange(bins.count)
        highest = 0.999 * concrete_number(self.lidar.altitude)
        return np.minimum(-0.5 * SPEED_OF_LIGHT * time * abs(self.axis[2]), highest)

    def _where(self) -> tuple[float, float]:
        return concrete_number(self.lidar.altitude), concrete_number(self.lidar.zenith)


def _share(part: Values, rest: Values) -> Values:
    return part / np.maximum(part + rest, 1e-30)


def _worst(share: Values) -> float:
    """The largest of all wavelengths; 1 where it is undefined."""
    return float(min(np.max(np.where(np.isnan(share), 1.0, share), initial=0.0), 1.0))
