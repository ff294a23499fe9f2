"""Position of the digitiser's bins: at fixed instants, or from the first return on as in the paper (2.1).

Layout: a plate 1 m above the ground under a pulse of 2 ns, sampled every 4 ns. Bins that start at the first
return conserve the energy, start the record at the edge of the first echo, and change the peak of the ground.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlidar as jl

KEY = jax.random.key(0)


def record(window, height):
    lidar = jl.Lidar(
        pulse=jl.GaussianPulse(fwhm=2.0), sampling_interval=4.0, receiver=jl.Receiver(window=window)
    )
    scene = jl.Scene(
        plates=(jl.Plate(height=height, reflectance=0.3, transmittance=0.3),),
        ground=jl.Ground(reflectance=0.5),
    )
    return jl.simulate(lidar, scene, key=KEY, max_orders=1)


def test_energy_is_conserved_and_the_record_starts_with_the_first_return():
    fixed, opened = record("fixed", 1.0), record("first return", 1.0)
    total = 0.3 + 0.3**2 * 0.5
    assert float(jnp.sum(fixed.reflectance)) == pytest.approx(total, rel=1e-4)
    assert float(jnp.sum(opened.reflectance)) == pytest.approx(total, rel=2e-3)
    assert np.allclose(np.diff(np.asarray(opened.time)), 4.0, atol=1e-4)
    # The plate returns at -6.67 ns; its pulse rises about 2.7 ns earlier.
    first = float(opened.time[0]) - 2.0
    assert first == pytest.approx(-6.67 - 2.7, abs=0.6)
    for name, component in opened.components.items():
        assert float(jnp.sum(component)) == pytest.approx(
            float(jnp.sum(fixed.components[name])), rel=5e-3, abs=1e-6
        )


@pytest.mark.slow
def test_the_ground_peak_depends_on_the_scene_above_it():
    """The height of the plate changes the samples of the ground, unless they lie at fixed instants."""
    grounds = {}
    for window in ("fixed", "first return"):
        grounds[window] = [float(jnp.max(record(window, h).components["ground"])) for h in (2.0, 2.2)]
    assert grounds["fixed"][0] == pytest.approx(grounds["fixed"][1], rel=1e-4)
    assert abs(grounds["first return"][0] / grounds["first return"][1] - 1) > 0.02


def test_a_window_that_opens_at_the_first_return_is_refused_within_a_transformation():
    """The fine samples would be returned in place of those of the digitiser."""
    lidar = jl.Lidar(receiver=jl.Receiver(window="first return"))
    scene = jl.Scene(ground=jl.Ground())
    plan = jl.plan(lidar, scene, max_orders=1)

    def total(reflectance):
        changed = jl.Scene(ground=jl.Ground(reflectance=reflectance))
        return jl.simulate(lidar, changed, plan=plan, key=jax.random.key(0)).reflectance.sum()

    assert float(total(0.3)) > 0.0
    with pytest.raises(ValueError, match="first_return_window"):
        jax.jit(total)(0.3)
