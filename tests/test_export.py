"""Programs for other machines: `jax.export` lowers a simulation and its gradient for absent devices."""

import jax
import jax.numpy as jnp

import jaxlidar as jl


def test_value_and_gradient_are_lowered_for_cpu_cuda_and_tpu():
    """None of these devices is needed for it."""
    lidar, ground = jl.Lidar(divergence=10.0), jl.Ground(reflectance=0.3)

    def scene(lad):
        voxels = jl.VoxelMap.from_lad(lad, voxel_size=1.0, origin=(-1.0, -1.0, 0.0))
        return jl.Scene(canopy=jl.Canopy(voxels, leaf=jl.LeafOptics(0.45, 0.4)), ground=ground)

    lad, key = jnp.full((2, 2, 2), 0.2), jax.random.key(0)
    plan = jl.plan(lidar, scene(lad), max_orders=2, n_photons=512, window=(-20.0, 20.0))

    def misfit(lad, key):
        return jnp.sum(jl.simulate(lidar, scene(lad), plan=plan, key=key).reflectance ** 2)

    program = jax.jit(jax.value_and_grad(misfit))
    exported = jax.export.export(program, platforms=("cpu", "cuda", "tpu"))(lad, key)
    assert exported.platforms == ("cpu", "cuda", "tpu")
    assert [aval.shape for aval in exported.out_avals] == [(), lad.shape]
