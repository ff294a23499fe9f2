"""Upper bounds on what leaving out an effect changes: cheap to compute, and valid for every scene.

They hold up to the resolution of 2048 rays of the footprint, 201 depths of the canopy and 400 cells of the
pulse: the extremes over these, and the total variation of the pulse, are approached from below.

Symbols, all by wavelength:

- R, T: reflectance and transmittance of a material. v: its intensity factor for backscatter, pi times BRDF
  times cosine per unit reflectance, which is 1 for a Lambertian surface that is met at right angles.
- k: extinction coefficient of the canopy, 1/m. s: path length, m.
- tau: optical depth of a ray through the canopy. x = exp(-tau): transmittance.
- kappa: 2, or 1 with the hot spot; light of order one is attenuated by exp(-kappa tau) on its way in and out.
- c, P: coverage of a plate, and the fraction of light that meets no plate or passes all of them straight on.
- F, H: returns of order one and of all higher orders, of a ray or of the footprint. S = F + H.

**Order one.** A ray that meets a canopy above ground returns

    F = integral of k R v exp(-kappa tau) ds + R_ground v_ground exp(-kappa tau_total).

The integral of k exp(-kappa tau) is (1 - exp(-kappa tau_total)) / kappa, so that F is a weighted mean of
R v / kappa of leaf and bark and of R v of the ground, with weights that add up to one. F lies between the
least and the largest of these numbers, F_min and F_max, wherever the leaves are. What holds for the ratio of
two returns of every ray holds for the footprint: a ratio of sums lies between the least and the largest ratio
of the summands. Plates multiply the return of what lies behind them by P^2.

**Comparison.** For the measure "sum" (see `planning.effects.Effect`) the change from S to S' is
|S - S'| / max(S, S'): 1 - S'/S where the scene gets darker without the effect, 1 - S/S' where it gets
brighter. For "samples" it is the sum of |a_i - b_i| over that of a_i + b_i, with samples a and b.

**All orders.** If order one changes by at most d, and at most a fraction h of the light is of higher order,
with the effect and without it, then all orders change by at most 1 - (1 - d) (1 - h): where S' < S,
S' >= F' >= (1 - d) F >= (1 - d) (1 - h) S.

The transmittance of the air within the depth of the scene is taken to be the same with and without an effect.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import concrete_array, concrete_number
from jaxlidar._vectors import Vec, scale, vec
from jaxlidar.optics.facets import FACET_BACKSCATTER
from jaxlidar.optics.laws import AbstractLaw, AbstractMirror
from jaxlidar.optics.phase import AbstractPhase
from jaxlidar.planning.channels import scene_optics
from jaxlidar.planning.config import TimeBins
from jaxlidar.scenes.canopy import Canopy
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import AbstractSheet, AbstractSurface
from jaxlidar.sensors.field_of_view import visible_fraction
from jaxlidar.sensors.lidar import Lidar, tan_half

PerWavelength = Float[np.ndarray, "wavelengths"]
Rays = Float[np.ndarray, "rays 3"]
PerRay = Float[np.ndarray, "rays"]

# Cells of the pulse; more would add up the rounding of single precision.
_PULSE_CELLS = 400
# Rings of footprint rays, and rays of each ring.
_RINGS, _RAYS_PER_RING = 64, 32
# A mirror's intensity factor is as large as its lobe is narrow: in effect it has no bound.
_MIRROR_FACTOR = 1e30
# Divisors are at least this, so that 0 / 0, where nothing returns either way, is 0: no change.
_TINY = 1e-30


class PlateFractions(NamedTuple):
    """Fractions of all light that comes to a plate's height, whether it meets the plate or a gap.

    - `reflected`: c R. - `scattered`: c (R + T); c R where the plate transmits straight on. - `straight`:
      1 - c, for the gaps, and c T where the plate transmits straight on.
    """

    reflected: PerWavelength
    scattered: PerWavelength
    straight: PerWavelength


class Bounds:
    """Bounds on what each `Effect` changes in a scene simulated up to a given order.

    Most methods bound the effect that they are named after. Bounds are for the worst wavelength, and in
    [0, 1].

    **Arguments:**

    - `lidar`, `scene`: with the effects of interest; all surfaces are planes.
    - `orders`: number of scatterings that are simulated.
    """

    def __init__(self, lidar: Lidar, scene: Scene, orders: int):
        self.lidar, self.scene, self.orders = lidar, scene, orders
        self.slant_range = concrete_number(lidar.range_to_reference)
        self.aperture_half_angle = concrete_number(lidar.aperture_half_angle)
        self.beam_axis = concrete_array(lidar.direction)
        self.rays, self.visible_fractions = footprint_rays(lidar)
        self.fraction_out_of_view = 1.0 - float(np.mean(self.visible_fractions))
        opaque = np.zeros(lidar.wavelength.size)
        # (reflectance, transmittance) of each material, by name.
        self.optics = {
            material.name: (
                concrete_array(material.reflectance),
                opaque if material.transmittance is None else concrete_array(material.transmittance),
            )
            for material in scene_optics(lidar, scene)
        }
        # Materials are in the order leaf, bark, surfaces.
        surface_names = [name for name in self.optics if name not in ("leaf", "bark")]
        self.surfaces = dict(zip(surface_names, scene.surfaces))
        self.plate_surfaces = {name: s for name, s in self.surfaces.items() if isinstance(s, AbstractSheet)}
        self.kappa = 1.0 if scene.canopy is not None and scene.canopy.hotspot else 2.0

    # -- returns of materials ------------------------------------------------------------------------------

    def _backscatter_range(self, name: str) -> tuple[float, float]:
        """Least and largest intensity factor v of a material for backscatter, over all rays."""
        canopy = self.scene.canopy
        if name not in ("leaf", "bark"):
            factors = self._surface_backscatter(self.surfaces[name], self.rays)
            return (0.0, _MIRROR_FACTOR) if factors is None else (float(factors.min()), float(factors.max()))
        assert canopy is not None
        phase = canopy.leaf_phase if name == "leaf" else canopy.bark_phase
        if phase is not None:
            factors = backscatter_factors(phase, self.rays)
            return float(factors.min()), float(factors.max())
        if name == "leaf" and canopy.voxels.leaf_angles is not None:
            # Lambertian facets: the mean squared cosine of their angle to the ray over the mean cosine.
            mean_cosine, mean_square = (concrete_array(t) for t in canopy.voxels.leaf_angles.tables())
            table_cosines = np.linspace(0, 1, mean_cosine.size)
            factors = np.interp(np.abs(self.rays[:, 2]), table_cosines, mean_square / mean_cosine)
            return float(factors.min()), float(factors.max())
        return FACET_BACKSCATTER, FACET_BACKSCATTER

    def _largest_intensity_factor(self, name: str) -> float:
        """Largest intensity factor of what a material scatters, for any two directions."""
        canopy = self.scene.canopy
        if name not in ("leaf", "bark"):
            return self.surfaces[name].law.largest_intensity_factor(self.aperture_half_angle)
        assert canopy is not None
        phase = canopy.leaf_phase if name == "leaf" else canopy.bark_phase
        if phase is not None:
            return phase.largest_intensity_factor()
        # A Lambertian facet's factor is a cosine, at most 1. Spherically oriented facets are brightest in
        # backscatter.
        return 1.0 if name == "leaf" and canopy.voxels.leaf_angles is not None else FACET_BACKSCATTER

    def _surface_backscatter(self, surface: AbstractSurface, rays: Rays) -> PerRay | None:
        """Intensity factors of a surface for backscatter, zero from under the ground; None for a mirror."""
        if isinstance(surface.law, AbstractMirror):
            return None
        normal, _ = surface.shape.tangent(vec(jnp.zeros(3)))
        upward = np.stack([concrete_array(n) for n in normal])
        is_sheet = isinstance(surface, AbstractSheet)
        return backscatter_factors(surface.law, rays, upward, self.aperture_half_angle, is_sheet)

    def _plate_fractions(self, name: str) -> PlateFractions:
        plate, (r, t) = self.plate_surfaces[name], self.optics[name]
        coverage, straight = concrete_number(plate.coverage), plate.transmission == "straight"
        return PlateFractions(
            reflected=coverage * r,
            scattered=coverage * (r if straight else r + t),
            straight=1 - coverage + coverage * t * straight,
        )

    def _first_order_range(self, without: str | None = None) -> tuple[PerWavelength, PerWavelength]:
        """Least and largest return of order one of a ray, F_min and F_max (see the module), without plates.

        `without` names a material that is left out. F_min is zero where there is no ground: a ray may then
        meet nothing.
        """
        least = np.full(self.lidar.wavelength.size, np.inf)
        largest = np.zeros_like(least)
        for name in ("leaf", "bark", "ground"):
            if name in self.optics and name != without:
                r = self.optics[name][0] / (1.0 if name == "ground" else self.kappa)
                low, high = self._backscatter_range(name)
                least, largest = np.minimum(least, r * low), np.maximum(largest, r * high)
        return (least if self.scene.ground is not None else np.zeros_like(least)), largest

    def _straight_through_plates(self) -> PerWavelength:
        """Fraction P that meets no plate or goes straight through all plates, one way."""
        fractions = [self._plate_fractions(name).straight for name in self.plate_surfaces]
        return np.prod([np.ones(self.lidar.wavelength.size), *fractions], axis=0)

    def _largest_plate_return(self) -> PerWavelength:
        """Largest return of order one of all plates together: the sum of c R v."""
        returns = [
            self._plate_fractions(n).reflected * self._backscatter_range(n)[1] for n in self.plate_surfaces
        ]
        return np.sum([np.zeros(self.lidar.wavelength.size), *returns], axis=0)

    # -- multiple scattering -------------------------------------------------------------------------------

    def orders_beyond(self, order: int) -> float:
        """Largest fraction of the sum S that orders above `order` can have.

        Let E be the energy that is scattered in these orders. At most v E of it returns, with the largest
        intensity factor v of any material and directions, so that the fraction is at most

            v E / (F + v E) = 1 / (1 + F / (v E)).

        E / F is bounded in closed form for a single plate above ground, and by a geometric series otherwise.
        """
        if self.scene.canopy is None and len(self.scene.surfaces) <= 1:
            return 0.0
        largest_factor = max(map(self._largest_intensity_factor, self.optics), default=0.0)
        # Division by zero gives infinity, and the bound 1, where no return of order one is certain.
        with np.errstate(divide="ignore", invalid="ignore"):
            if self._is_plate_over_ground():
                scattered = self._scattered_between_plate_and_ground(order)
            else:
                scattered = self._scattered_in_any_scene(order)
            # v E / F.
            higher_per_first_order = largest_factor * scattered
            fraction = 1.0 / (1.0 + 1.0 / higher_per_first_order)
            return _worst_wavelength(np.where(scattered > 0, fraction, 0.0))

    def _scattered_between_plate_and_ground(self, order: int) -> PerWavelength:
        """Energy E that a plate and the ground scatter above `order`, over the return F of order one.

        With the plate's scattered fraction s, its straight one p and the ground's R, plate and ground scatter
        at most

            A_1 = s, B_1 = p R, and A_(n+1) = s B_n, B_(n+1) = R A_n:

        all that one of them scatters meets the other. As A_(n+2) = s R A_n, and likewise B, the sum over all
        n > order is the sum of its first two terms over 1 - s R.
        """
        (name,), (r, _) = self.plate_surfaces, self.optics["ground"]
        plate = self._plate_fractions(name)
        plate_return = plate.reflected * self._backscatter_range(name)[0]
        ground_return = plate.straight**2 * r * self._backscatter_range("ground")[0]
        from_plate, from_ground = plate.scattered, plate.straight * r
        for _ in range(order):
            from_plate, from_ground = plate.scattered * from_ground, r * from_plate
        two_orders = from_plate + from_ground + plate.scattered * from_ground + r * from_plate
        first_order = (plate_return + ground_return) * (1.0 - self.fraction_out_of_view)
        return two_orders / (1.0 - r * plate.scattered) / first_order

    def _scattered_in_any_scene(self, order: int) -> PerWavelength:
        """Energy E that anything scatters above `order`, over the return F of order one.

        What is scattered n + 1 times is at most s times what is scattered n times, with s the largest
        fraction that a ray scatters of its energy where it meets something, also after passing plates. With
        E_1 for what is scattered once,

            E <= E_1 (s^order + s^(order + 1) + ...) = E_1 s^order / (1 - s).

        Within the field of view, E_1 / F is at most the ratio for any one element of the scene
        (`_largest_scattered_per_return`, and (R + T) / (R v) of plates), divided by the transmittance P of
        the plates that the return passes. Outside, where the fraction u of the energy is, s u is scattered
        and nothing returns, whereas F is at least F_min P^2 (1 - u).
        """
        s, return_transmittance = np.zeros(self.lidar.wavelength.size), 1.0
        for name, (r, t) in self.optics.items():
            if name not in self.plate_surfaces:
                s = np.maximum(s, r + t)
        ratio = self._largest_scattered_per_return()
        for name in self.plate_surfaces:
            plate = self._plate_fractions(name)
            plate_ratio = plate.scattered / (plate.reflected * self._backscatter_range(name)[0])
            ratio = np.maximum(ratio, np.where(plate.scattered > 0, plate_ratio, 0.0))
            # Behind the plate E_1 and F are dimmed on the way in, and F once more on the return path. Behind
            # an opaque plate nothing is lit, so that it counts as transparent.
            return_transmittance = return_transmittance * np.where(plate.straight > 0, plate.straight, 1.0)
        # After any plate another may follow. Each repetition takes in one more, as often as there are plates.
        for _ in self.plate_surfaces:
            s = np.max(
                [s, *(self._scattered_at_plate_or_behind(name, s) for name in self.plate_surfaces)], axis=0
            )
        out_of_view = np.zeros_like(s)
        if self.fraction_out_of_view > 0:
            least_return = self._first_order_range()[0] * self._straight_through_plates() ** 2
            out_of_view = s * self.fraction_out_of_view / (least_return * (1.0 - self.fraction_out_of_view))
        scattered_once = ratio / return_transmittance + out_of_view
        return np.where(s > 0, s**order / (1.0 - s) * scattered_once, 0.0)

    def _largest_scattered_per_return(self) -> PerWavelength:
        """Largest ratio of the energy that canopy and ground scatter once to its return, without plates.

        Canopy and ground scatter and return, of a ray whose transmittance through the canopy is x,

            scattered <= (1 - x) (R + T)_max + x R_ground,
            returned >= (1 - x^kappa) / kappa (R v)_min + x^kappa R_ground v_min,

        with the extremes over leaf and bark. The largest ratio is looked for over x from that of the largest
        depth to 1, with the ground and without it, as a ray may end at a plate before the ground.
        """
        canopy = self.scene.canopy
        least_x = 1.0 if canopy is None else np.exp(-self._largest_depth(canopy))
        x = np.linspace(least_x, 1.0, 201)[:, None]
        scattered = returned = ratio = np.zeros((x.size, self.lidar.wavelength.size))
        materials = [name for name in ("leaf", "bark") if name in self.optics]
        if materials:
            scattered = (1.0 - x) * np.max([np.sum(self.optics[n], axis=0) for n in materials], axis=0)
            least = np.min([self.optics[n][0] * self._backscatter_range(n)[0] for n in materials], axis=0)
            returned = (1.0 - x**self.kappa) / self.kappa * least
            ratio = np.where(scattered > 0, scattered / returned, 0.0)
        if "ground" in self.optics:
            r = self.optics["ground"][0]
            scattered = scattered + x * r
            returned = returned + x**self.kappa * r * self._backscatter_range("ground")[0]
            ratio = np.maximum(ratio, np.where(scattered > 0, scattered / returned, 0.0))
        return np.max(ratio, axis=0)

    def _scattered_at_plate_or_behind(self, name: str, behind: PerWavelength) -> PerWavelength:
        """Fraction of a ray that is scattered at a plate, or behind it where the fraction is `behind`."""
        plate = self._plate_fractions(name)
        return plate.scattered + plate.straight * behind

    def _with_higher_orders(self, first_order_bound: float) -> float:
        """Bound for all orders, 1 - (1 - d) (1 - h) (see the module), from the bound d for order one."""
        higher_orders = self.orders_beyond(1) if self.orders > 1 else 0.0
        return 1.0 - (1.0 - first_order_bound) * (1.0 - higher_orders)

    # -- materials and surfaces ----------------------------------------------------------------------------

    def canopy_material(self, name: str) -> float:
        """Bound on the change without leaf, or without bark.

        The material, of depth tau at most, lets at least the fraction y = exp(-kappa tau) of all other light
        through, both ways, and returns at most A = R v (1 - y) / kappa. Let F' be the return without it, and
        F_min its least value. With the material the ray returns at least y F': without it, the scene is
        brighter by at most

            (F' - F) / F' <= 1 - y,

        and darker by at most (F - F') / F <= A / (A + F') <= A / (A + F_min), since F <= A + F'.
        """
        canopy = self.scene.canopy
        # Without ground, nothing but the material may be in view.
        if canopy is None or self.scene.ground is None or self.scene.plates:
            return 1.0
        y = np.exp(-self.kappa * self._largest_depth(canopy, name))
        material_return = self.optics[name][0] * self._backscatter_range(name)[1] * (1.0 - y) / self.kappa
        darker = _worst_wavelength(_fraction(material_return, self._first_order_range(name)[0]))
        return self._with_higher_orders(max(1.0 - float(y), darker))

    def plates(self) -> float:
        """Bound on the change without plates, which shade what lies behind by P^2 and return light.

        With plates the ray returns at most A + P^2 F', where F' is the return without them, and at least
        a + P^2 F' if all rays meet the plate before the ground; a and A are the extremes of c R v. So plates
        make the scene

            darker by   (F' - F) / F' <= 1 - P^2 - a / F_max,
            brighter by (F - F') / F  <= (A - (1 - P^2) F_min) / (A + P^2 F_min).
        """
        straight_both_ways = self._straight_through_plates() ** 2
        (least, largest), plate_return = self._first_order_range(), self._largest_plate_return()
        if self._is_plate_over_ground():
            (name,) = self.plate_surfaces
            least_plate_return = self._plate_fractions(name).reflected * self._backscatter_range(name)[0]
            darker = 1.0 - straight_both_ways - least_plate_return / np.maximum(largest, _TINY)
            excess = plate_return - (1.0 - straight_both_ways) * least
            brighter = excess / np.maximum(plate_return + straight_both_ways * least, _TINY)
        else:
            # Some rays may meet the canopy or the ground before the plates: these then neither shade it nor
            # certainly return light.
            darker = 1.0 - straight_both_ways
            brighter = _fraction(plate_return, straight_both_ways * least)
        return self._with_higher_orders(_worst_wavelength(np.maximum(np.maximum(darker, brighter), 0.0)))

    def ground(self) -> float:
        """Bound on the change without the ground: up to the whole return.

        Below one plate, the ground's largest return through it, P^2 F_max, relative to its sum with the
        plate's least return c R v.
        """
        if not self._is_plate_over_ground():
            return 1.0
        (name,) = self.plate_surfaces
        plate = self._plate_fractions(name)
        ground_return = self._first_order_range()[1] * plate.straight**2
        plate_return = plate.reflected * self._backscatter_range(name)[0]
        return self._with_higher_orders(_worst_wavelength(_fraction(ground_return, plate_return)))

    def _is_plate_over_ground(self) -> bool:
        """Return True if the scene is ground and one plate, which every ray meets before the ground."""
        if self.scene.canopy is not None or self.scene.ground is None or len(self.scene.plates) != 1:
            return False
        to_ground, to_plate = (self._distance(s, self.rays) for s in self.scene.surfaces)
        return bool(np.all(to_plate > 0) and np.all(to_plate < to_ground))

    # -- delays and the beam -------------------------------------------------------------------------------

    def slope_spread(self, level: "Bounds") -> float:
        """Bound on the change as sloping ground is levelled; `level` has the bounds of the level scene.

        Each ray changes its delay and its intensity factor (`_sample_change`).
        """
        sloping_ground, level_ground, canopy = self.scene.ground, level.scene.ground, self.scene.canopy
        assert sloping_ground is not None
        assert level_ground is not None
        if not (self._surface_order_is_the_same() and level._surface_order_is_the_same()):
            return 1.0
        if canopy is not None:
            # Rays reach the ground with different energies. These stay the same only if sloping and level
            # ground lie beneath the canopy.
            to_sloping, to_level = (self._distance(g, self.rays) for g in (sloping_ground, level_ground))
            if np.any(np.minimum(to_sloping, to_level) < self._distance_to_canopy_base(canopy)):
                return 1.0
        change = self._sample_change(
            (sloping_ground, self.rays, self.visible_fractions),
            (level_ground, self.rays, self.visible_fractions),
            unequal_energies=canopy is not None,
        )
        return max(self._with_higher_orders(change), level._with_higher_orders(change))

    def divergence(self) -> float:
        """Bound on the change as all rays of the beam are replaced by its axis (`_sample_change`)."""
        if self.scene.canopy is not None or not self._surface_order_is_the_same():
            return 1.0
        axis, in_view = np.broadcast_to(self.beam_axis, self.rays.shape), np.ones_like(self.visible_fractions)
        changes = (
            self._sample_change((s, self.rays, self.visible_fractions), (s, axis, in_view))
            for s in self.scene.surfaces
        )
        return self._with_higher_orders(max(changes, default=0.0))

    def _surface_order_is_the_same(self) -> bool:
        """Return True if all rays meet the surfaces in the same order; then these shade all rays equally."""
        distances = [self._distance(s, self.rays) for s in self.scene.surfaces]
        order = np.argsort(distances, axis=0) if distances else np.zeros((0, 1))
        return bool(np.all(order == order[:, :1]))

    def _distance_to_canopy_base(self, canopy: Canopy) -> PerRay:
        """Distance along rays to the bottom of the lowest layer that has any extinction."""
        n_empty_layers = np.argmax(self._largest_extinction(canopy) > 0)
        layer_height = concrete_number(canopy.voxels.voxel_size[2])
        bottom = concrete_array(canopy.voxels.origin)[2] + layer_height * n_empty_layers
        return (bottom - concrete_number(self.lidar.altitude)) / self.rays[:, 2]

    def _sample_change(
        self,
        before: tuple[AbstractSurface, Rays, PerRay],
        after: tuple[AbstractSurface, Rays, PerRay],
        unequal_energies: bool = False,
    ) -> float:
        """Bound on the change of samples as each ray of `before` is replaced by the same ray of `after`.

        Each is a surface, the rays that meet it, and the visible fraction of every ray. Let a and b be the
        returns of a ray, the product of intensity factor and visible fraction, and dt their difference in
        time. With the pulse's power p(t), and V half its total variation,

            integral of |p(t) - p(t - dt)| <= 2 m,    m = min(V dt, 1),

        so that the samples of the ray change by at most |a - b| + 2 m min(a, b), of a + b in all. For the
        footprint, sums over rays are compared; with `unequal_energies` the largest ratio of any ray.
        """
        (surface_a, rays_a, visible_a), (surface_b, rays_b, visible_b) = before, after
        a, b = self._surface_backscatter(surface_a, rays_a), self._surface_backscatter(surface_b, rays_b)
        if a is None or b is None:
            return 1.0
        a, b = a * visible_a, b * visible_b
        path_difference = 2.0 * np.abs(self._distance(surface_a, rays_a) - self._distance(surface_b, rays_b))
        dt = path_difference / SPEED_OF_LIGHT
        # A pulse without duration has infinite V, and V dt is undefined at dt = 0.
        moved = np.minimum(self._half_pulse_variation() * np.maximum(dt, _TINY), 1.0)
        moved = np.where(dt > 0, moved, 0.0)
        change, total = np.abs(a - b) + 2.0 * np.minimum(a, b) * moved, a + b
        if unequal_energies:
            return float(np.max(change / np.maximum(total, _TINY)))
        return float(np.sum(change) / max(np.sum(total), _TINY))

    def _distance(self, surface: AbstractSurface, rays: Rays) -> PerRay:
        """Distance, m, from the sensor at which rays meet a surface."""
        sensor = np.append(concrete_array(self.lidar.position), 0.0) - self.slant_range * self.beam_axis
        return np.asarray(surface.shape.crossing(np.broadcast_to(sensor, rays.shape), rays)[0])

    def _half_pulse_variation(self) -> float:
        """Half the total variation of the pulse's power, 1/ns; for a pulse with one peak, the peak power."""
        jitter = concrete_number(self.lidar.jitter)
        low, high = self.lidar.pulse.support(jitter)
        if not high > low:
            return np.inf
        power = np.diff(self._cumulative_pulse(low, high, jitter)) * _PULSE_CELLS / (high - low)
        return 0.5 * float(np.sum(np.abs(np.diff(power, prepend=0.0, append=0.0))))

    def _cumulative_pulse(self, low: float, high: float, jitter: float) -> np.ndarray:
        """Fraction of the pulse's energy that has passed, at the edges of cells from `low` to `high` ns."""
        return concrete_array(self.lidar.pulse.cumulative(np.linspace(low, high, _PULSE_CELLS + 1), jitter))

    def jitter(self) -> float:
        """Bound on the change without jitter: 1/2 integral of |p_jitter - p|, for the pulse's power p.

        A waveform is a sum of such pulses with weights that are not negative, so that by the triangle
        inequality its samples change by no larger fraction.
        """
        jitter = concrete_number(self.lidar.jitter)
        low, high = self.lidar.pulse.support(jitter)
        with_jitter, without_jitter = (np.diff(self._cumulative_pulse(low, high, j)) for j in (jitter, 0.0))
        return min(0.5 * float(np.sum(np.abs(with_jitter - without_jitter))), 1.0)

    def field_of_view(self) -> float:
        """Bound on the change without a field of view, outside of which is the fraction u of the energy.

        What comes into view is at most A = F_max u, what was in view at least a = F_min (1 - u), so that the
        change is at most A / (A + a). On a single plane the returns of rays are known: the change is the
        fraction of their sum that is out of view.
        """
        if self.scene.canopy is None and len(self.scene.surfaces) == 1:
            (surface,) = self.scene.surfaces
            factors = self._surface_backscatter(surface, self.rays)
            if factors is None:
                return 1.0
            out_of_view = np.sum(factors * (1.0 - self.visible_fractions))
            return float(out_of_view / max(np.sum(factors), _TINY))
        least, largest = self._first_order_range()
        largest = largest + self._largest_plate_return()
        least = least * self._straight_through_plates() ** 2
        u = self.fraction_out_of_view
        return self._with_higher_orders(_worst_wavelength(_fraction(largest * u, least * (1.0 - u))))

    def hot_spot(self) -> float:
        """Bound on the change by the hot spot: 1 - exp(-tau), with the largest depth tau.

        The hot spot replaces exp(-2 tau) by exp(-tau) in each return of order one. It does not change higher
        orders, so that the bound holds for the sum.
        """
        canopy = self.scene.canopy
        return 0.0 if canopy is None else 1.0 - float(np.exp(-self._largest_depth(canopy)))

    def _largest_extinction(self, canopy: Canopy, name: str | None = None) -> Float[np.ndarray, "layers"]:
        """Extinction, 1/m, of the densest voxel of every layer: of leaf, of bark, or (None) of their sum."""
        v = canopy.voxels
        maps = [
            concrete_array(extinction)
            for material, extinction in (("leaf", v.leaf), ("bark", v.bark))
            if extinction is not None and name in (None, material)
        ]
        # Maps state the extinction for the projection function G = 1/2. With other leaf angles G depends on
        # direction, and is at most 1: twice that.
        angle_factor = 1.0 if v.leaf is None or v.leaf_angles is None or name == "bark" else 2.0
        return angle_factor * np.max(np.sum(maps, axis=0), axis=(0, 1))

    def _largest_depth(self, canopy: Canopy, name: str | None = None) -> float:
        """Largest optical depth along any ray: through the densest voxel of every layer, most inclined."""
        least_cosine = float(np.min(np.abs(self.rays[:, 2])))
        layer_height = concrete_number(canopy.voxels.voxel_size[2])
        return float(np.sum(self._largest_extinction(canopy, name))) * layer_height / least_cosine

    # -- atmosphere ----------------------------------------------------------------------------------------

    def atmospheric_extinction(self, bins: TimeBins, start_distance: float) -> float:
        """Bound on the change without the air, and so without its own return either.

        Extinction makes a scene darker by at most `air_loss`, the air's return makes it brighter by at most
        `atmospheric_backscatter`. The two counteract, so that the larger of them bounds the change.
        """
        return max(self.air_loss(bins), self.atmospheric_backscatter(bins, start_distance))

    def air_loss(self, bins: TimeBins) -> float:
        """Fraction of light lost in the air, 1 - T^2, on the longest path: to the height of the last bin."""
        air = self.scene.atmosphere
        if air is None:
            return 0.0
        lowest = self._bin_heights(bins)[-1]
        transmittance = air.two_way_transmittance(self.lidar.wavelength, lowest, *self._sensor_view())
        return 1.0 - float(np.min(concrete_array(transmittance)))

    def atmospheric_backscatter(self, bins: TimeBins, start_distance: float) -> float:
        """Bound on the change without the air's return A: A / (A + a), with the least return a of the scene.

        A is the sum over bins above the scene, a is F_min P^2 (1 - u) times the transmittance of the air.
        `start_distance` is the distance, m, before the reference plane at which rays start.
        """
        air = self.scene.atmosphere
        if air is None or air.lidar_ratio is None:
            return 0.0
        heights = self._bin_heights(bins)
        per_metre = concrete_array(air.backscatter(self.lidar.wavelength, heights, *self._sensor_view()))
        # Rays start above all of the scene: from there on down the air's return is not simulated.
        above_scene = heights > start_distance * abs(self.beam_axis[2])
        metres_per_ns = 0.5 * SPEED_OF_LIGHT
        air_return = np.sum(np.where(above_scene, per_metre, 0.0), axis=1) * metres_per_ns * bins.width
        least_return = self._first_order_range()[0] * self._straight_through_plates() ** 2
        in_view = 1.0 - self.fraction_out_of_view
        least_return = least_return * in_view * (1.0 - self.air_loss(bins))
        return _worst_wavelength(_fraction(air_return, least_return))

    def _bin_heights(self, bins: TimeBins) -> np.ndarray:
        """Heights, m, above the reference plane from which single returns fall into the bins."""
        time = bins.start + bins.width * np.arange(bins.count)
        # The air's backscatter grows without bound towards the sensor.
        highest = 0.999 * concrete_number(self.lidar.altitude)
        return np.minimum(-0.5 * SPEED_OF_LIGHT * time * abs(self.beam_axis[2]), highest)

    def _sensor_view(self) -> tuple[float, float]:
        """Altitude, m, and zenith angle, degrees, of the lidar."""
        return concrete_number(self.lidar.altitude), concrete_number(self.lidar.zenith)


def _fraction(changed: PerWavelength, unchanged: PerWavelength) -> PerWavelength:
    """Return changed / (changed + unchanged); it rises with the former and falls with the latter."""
    return changed / np.maximum(changed + unchanged, _TINY)


def _worst_wavelength(fraction: PerWavelength) -> float:
    """Return the largest fraction of all wavelengths, 1 at most; 1 where it is undefined."""
    return float(min(np.max(np.where(np.isnan(fraction), 1.0, fraction), initial=0.0), 1.0))


# -- rays of the footprint ---------------------------------------------------------------------------------


def footprint_rays(lidar: Lidar) -> tuple[Rays, PerRay]:
    """Return directions of footprint rays of equal energy, and the fraction of each that the receiver sees.

    The rays cross the plane through the aim point on rings that divide the energy equally. With w the
    footprint radius at 1/e^2, the energy within r is u = 1 - exp(-2 r^2 / w^2) of a Gaussian beam, hence
    r = w sqrt(-ln(1 - u) / 2), and u = r^2 / w^2 of a top-hat beam.
    """
    axis, slant_range = concrete_array(lidar.direction), concrete_number(lidar.range_to_reference)
    radius = concrete_number(lidar.footprint_radius)
    u, turn = ((np.arange(n) + 0.5) / n for n in (_RINGS, _RAYS_PER_RING))
    r = radius * (np.sqrt(-0.5 * np.log1p(-u)) if lidar.profile == "gaussian" else np.sqrt(u))
    # Any direction across the axis; of x and y that which is not nearly along it.
    across = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.7 else [0, 1.0, 0])
    across /= np.linalg.norm(across)
    circle = np.outer(np.cos(2 * np.pi * turn), across)
    circle = circle + np.outer(np.sin(2 * np.pi * turn), np.cross(axis, across))
    rays = (axis * slant_range + r[:, None, None] * circle).reshape(-1, 3)
    visible = np.ones_like(r)
    if lidar.field_of_view is not None:
        view_radius = slant_range * tan_half(concrete_number(lidar.field_of_view), np)
        visible = visible_fraction(r / view_radius, np)
    return rays / np.linalg.norm(rays, axis=1)[:, None], np.repeat(visible, turn.size)


@eqx.filter_jit
def _backscatter_factor(
    law: AbstractLaw | AbstractPhase, incident: Vec, normal: Vec, half_angle: Array
) -> Array:
    back = scale(incident, jnp.asarray(-1.0))
    if isinstance(law, AbstractPhase):
        return law.intensity_factor(incident, back)
    return law.intensity_factor(incident, normal, back, half_angle)


def backscatter_factors(
    law: AbstractLaw | AbstractPhase,
    rays: Rays,
    normal: Float[np.ndarray, "3"] | None = None,
    half_angle: float = 0.0,
    two_sided: bool = False,
) -> PerRay:
    """Return the intensity factors of light that is scattered straight back along rays.

    **Arguments:**

    - `law`: of a surface, or the phase function of a canopy's material.
    - `rays`: directions, unit vectors.
    - `normal`: upward normal of a surface. Default None: the law is a phase function.
    - `half_angle`: of the cone from the target to the aperture, rad.
    - `two_sided`: True if the surface also scatters light from below; otherwise the factor is zero there.
    """
    normal = np.zeros(3) if normal is None else normal
    from_below = rays @ normal > 0
    lit_side = np.where(from_below & two_sided, -1.0, 1.0)[:, None] * normal
    # In double precision: bounds are ratios of sums of these.
    with jax.enable_x64(True):
        incident, lit_normal = (vec(jnp.asarray(a)) for a in (rays.T, lit_side.T))
        factors = np.asarray(_backscatter_factor(law, incident, lit_normal, jnp.asarray(half_angle)), float)
    return np.where(from_below & (not two_sided), 0.0, factors)
