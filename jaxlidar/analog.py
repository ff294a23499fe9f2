"""The paper's own estimator (section 1.4): photons that are followed until they are back, gone or absorbed.

Kept to be compared with: it shares flights, collisions and optics with the tracer, but neither expected
returns at every collision, nor a deterministic first order, nor stratified numbers.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray

from ._checks import check_range
from ._vector import along, dot, vec
from .constants import SPEED_OF_LIGHT
from .lidar import Lidar
from .plan import Plan
from .scene import Scene, leaf_optics
from .trace.flight import DIMENSIONS, events_of, fly, nearest, plates_ahead
from .trace.footprint import quantile_radius
from .trace.histories import histories
from .trace.march import FAR
from .trace.photons import THROUGH, Photons, Setting
from .trace.response import geometry_of
from .trace.scatter import collide
from .waveform import is_straight, optics

CHUNK = 512


class AnalogReturns(eqx.Module):
    """What became of each photon.

    - `time`: (photons,) ns, of arrival at the sensor if it was sent at time zero; 0 where it did not return.
    - `weight`: (wavelengths, photons) apparent reflectance that it stands for; 0 where it did not return. The
      sum over photons, divided by their number, estimates the apparent reflectance of the scene.
    """

    time: Float[Array, "photons"]
    weight: Float[Array, "wavelengths photons"]


@eqx.filter_jit
def analog_returns(
    lidar: Lidar,
    scene: Scene,
    plan: Plan,
    *,
    key: PRNGKeyArray,
    n_photons: int,
    cone: float = 10.0,
) -> AnalogReturns:
    """Follow photons one by one and count those that leave within a cone about the direction to the sensor.

    At 1000 m an aperture of 0.2 m would see one photon in 10^8, so the cone stands in for it, here as in the
    paper; the estimate is that of `simulate` averaged over the cone. Independent random numbers throughout.

    **Arguments:**

    - `plan`: of `jaxlidar.plan`; its window and orders bound what is followed.
    - `n_photons`: how many, at least 1.
    - `cone`: half-angle, degrees, in (0, 90]. Default 10. Smaller is less biased and returns fewer.

    **Raises:** ValueError for values outside their ranges; for a hot spot, which photons that fly back
    on their own cannot have; and for several wavelengths where leaves transmit straight on.
    """
    check_range("cone", cone, 0.0, 90.0, low_open=True)
    check_range("n_photons", n_photons, 1)
    if scene.canopy is not None and scene.canopy.hotspot:
        raise ValueError("hotspot = True; admissible is False: the way back is independent of the way in")
    transmittance = 0.0
    if is_straight(scene):
        assert scene.canopy is not None
        if lidar.wavelength.size > 1:
            raise ValueError(
                f"wavelength has {lidar.wavelength.size} values; 1 where transmission is straight"
            )
        transmittance = leaf_optics(scene.canopy, lidar.wavelength)[1][0]
    beam, medium, surfaces = geometry_of(lidar, scene, transmittance)
    table = histories(len(plan.layout.letters), plan.degree)
    setting = Setting(beam, medium, surfaces, plan.layout, table, plan.bins)
    size = min(CHUNK, n_photons)
    monomials = table.monomials(optics(lidar, scene, plan))

    def chunk(key: PRNGKeyArray) -> tuple[Array, Array]:
        radius_key, turn_key, key = jax.random.split(key, 3)
        r = quantile_radius(beam, jax.random.uniform(radius_key, (size,), maxval=1.0 - 1e-7))
        turn = 2 * jnp.pi * jax.random.uniform(turn_key, (size,))
        point, w, excess = beam.ray((r * jnp.cos(turn), r * jnp.sin(turn)))
        up = jnp.asarray(-plan.layout.upstream, r.dtype)
        none = jnp.zeros((size,), jnp.int32)
        still = vec(jnp.zeros_like(r) for _ in range(3))
        start = Photons(
            along(point, w, up), w, excess + up, jnp.ones_like(r), none, none - 1, still, none == 0
        )

        def order(carry, n):
            def go(carry):
                photons, time, value, history = carry
                return _one_flight(setting, photons, time, value, history, jax.random.fold_in(key, n), cone)

            return lax.cond(jnp.any(carry[0].alive), go, lambda c: c, carry), None

        # One flight more than scatterings, to leave the scene.
        flights = jnp.arange(plan.orders + 1)
        nothing = (start, jnp.zeros_like(r), jnp.zeros_like(r), none)
        (_, time, value, history), _ = lax.scan(order, nothing, flights)
        return time, monomials[history].T * value[None, :]

    time, weight = lax.map(chunk, jax.random.split(key, -(-n_photons // size)))
    weight = jnp.moveaxis(weight, 1, 0)
    return AnalogReturns(time.reshape(-1)[:n_photons], weight.reshape(weight.shape[0], -1)[:, :n_photons])


def _one_flight(
    setting: Setting, p: Photons, time: Array, value: Array, history: Array, key: Array, cone: float
):
    """Fly, be counted if that leads out of the scene to the sensor, else collide and scatter."""
    beam, layout = setting.beam, setting.layout
    plates = sum(s.plate for s in setting.surfaces)
    tiny = jnp.finfo(p.weight.dtype).tiny
    u = list(jax.random.uniform(key, (DIMENSIONS + plates, p.weight.size), p.weight.dtype, tiny))
    met, outcomes, _ = plates_ahead(setting, p, u[DIMENSIONS:])
    events = events_of(setting, met, outcomes)
    limit = nearest(p, events)
    flight = fly(setting, p, limit, jnp.maximum(layout.max_path - p.path, 0.0), u[0])
    weight, letters = p.weight, p.history
    for i, (s, d, o) in enumerate(zip(setting.surfaces, met, outcomes)):
        if s.plate:
            through = p.alive & (o == THROUGH) & (d < FAR) & ((d < flight.distance) | ~flight.event)
            letters = jnp.where(through, setting.grow(letters, layout.surfaces[i].transmitted), letters)
            weight = jnp.where(through, weight / (1.0 - layout.lobe), weight)

    out = beam.excess(p.x)
    back = flight.escaped & (dot(p.w, beam.view(p.x)) > jnp.cos(jnp.deg2rad(cone)))
    # So that a level Lambertian surface returns its reflectance.
    share = weight * beam.in_view(p.x) / jnp.sin(jnp.deg2rad(cone)) ** 2
    time = jnp.where(back, (p.path + out) / SPEED_OF_LIGHT, time)
    value = jnp.where(back, share, value)
    history = jnp.where(back, letters, history)

    event = flight.event
    flown = jnp.where(event, flight.distance, 0.0)
    hit = collide(setting, p.w, flight.cell, flight.collided, flight.landed, events, limit, u)
    letters = setting.grow(letters, hit.letter)
    onward = Photons(
        along(p.x, p.w, flown),
        hit.w,
        p.path + flown,
        jnp.where(event, weight * hit.onward, 0.0),
        letters,
        hit.on,
        hit.facing,
        event,
    )
    return onward, time, value, history
