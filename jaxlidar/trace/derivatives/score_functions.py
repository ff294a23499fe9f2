r"""Score functions of paths: derivatives of the waveform with respect to parameters of extinction alone.

Where only extinction k moves, paths stay where they are. The weight of a path is a product of extinction
coefficients, where it collided, and of exp(-integral of k ds). Its score, d ln(weight) / d theta, is

    sum over collisions of (d k / d theta) / k  -  integral of (d k / d theta) ds,

along all that was flown, and along the return path. A collision in voxel v adds (d k_v / d theta) / k_v of
the material that was hit, a flight of length l through the voxel subtracts l d k_v / d theta, and the return
path subtracts the derivative of its optical depth. The derivative of the waveform is the mean of weight times
score (likelihood-ratio method; Rubinstein and Shapiro 1993).

Scores ("score" is the value of this function, not a contribution to a tally) are numbers like the weights
themselves, one for each parameter theta_j: no derivative is pushed through the march, which would carry
tangents of positions, directions and times along.

First order is deterministic, and differentiated piece by piece. A material with the
extinction k_m and the intensity factor V_m returns V_m E k_m I, with I = integral of exp(-kappa tau) ds,
from a piece of a segment of a ray of the energy E. The derivative is

    V_m E [ k_m (dI/dk) dk  +  I (d k_m - kappa k_m d tau_0) ],

with d the derivative with respect to theta_j, tau_0 the optical depth before the segment, and dI/dk taken at
fixed tau_0.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlidar._jax.mesh_axes import vary_with
from jaxlidar._vectors import Scalar, Vec
from jaxlidar.trace.deposit import add_rows
from jaxlidar.trace.derivatives.extinction_slopes import ExtinctionSlopes, outer_rows, pack_slopes
from jaxlidar.trace.device_scene import DeviceScene
from jaxlidar.trace.march.ray_segments import RaySegments, integrate_over_bins
from jaxlidar.trace.march.voxel_traversal import Medium, voxel_above
from jaxlidar.trace.photons.photons import Collision, detach
from jaxlidar.trace.tally_index import TallyIndex


def collision_score(
    scene: DeviceScene, cell: Int[Array, "photons"], collided: Bool[Array, "photons"], collision: Collision
) -> Float[Array, "photons parameters"]:
    """Score of a collision, (d k / d theta) / k of the material that was hit; zero on surfaces."""
    medium, config, slopes = scene.medium, scene.config, scene.slopes
    assert medium is not None
    assert slopes is not None
    # Collisions with surfaces do not depend on extinction.
    in_voxel = collided & (collision.surface < 0)
    by_material = []
    for table, scatterer in ((medium.leaf, config.leaf), (medium.bark, config.bark)):
        if table is None or scatterer is None:
            by_material.append(None)
            continue
        # Detached: a score is the first derivative itself, and is not differentiated again.
        by_material.append((in_voxel & (collision.material == scatterer.material), detach(table)))
    return slopes.log_extinction_slopes(cell, *by_material)


def vertical_depth_slopes(scene: DeviceScene, medium: Medium, x: Vec) -> Float[Array, "photons parameters"]:
    """Return derivatives of the optical depth from `x` straight up."""
    slopes = scene.slopes
    assert slopes is not None
    assert slopes.depth_above is not None
    cell, above, inside = detach(voxel_above(medium, x))
    up = (jnp.zeros_like(above), jnp.zeros_like(above), jnp.ones_like(above))
    # Length within the point's own voxel; the voxels above it are in the table.
    length = jnp.where(inside, above * detach(medium.size[2]), 0.0)
    in_voxel = [slope * length for slope in slopes.slopes_at(cell, medium.projection_factor(up))]
    in_voxel = slopes.to_all_parameters(slopes.parameters_at(cell), in_voxel, axis=-1)
    above_voxel = slopes.depth_above.at[cell].get(mode="promise_in_bounds")
    return jnp.where(inside[:, None], above_voxel, 0.0) + in_voxel


def add_derivatives_of_returns(
    scene: DeviceScene,
    tally: Float[Array, "bins parameters wavelengths"],
    first_bin: Int[Array, "photons"],
    row: Float[Array, "photons kernel"],
    score: Float[Array, "photons parameters"],
    channel_factors: list[tuple[Array, Scalar]],
    index: TallyIndex,
) -> Float[Array, "bins parameters wavelengths"]:
    """Add the derivatives of photons' returns, score times return, to a tally.

    1. For each channel by which light returns: its intensity factor times the optics of the history.
    2. The sum of these times the score, for each parameter and wavelength.
    3. That times the return in each bin, added to the tally.

    `channel_factors`: channels by which light returns, with intensity factors; `row`: returns without these
    factors.
    """
    slopes = scene.slopes
    assert slopes is not None
    # Optics are applied here, because derivatives by history, wavelength and parameter would not fit into
    # memory.
    returned = jnp.zeros((first_bin.size, slopes.history_optics.shape[1]), row.dtype)
    for channel, factor in channel_factors:
        factor = jnp.where(channel >= 0, factor, 0.0)
        history = index.after(scene, channel).number
        returned = returned + factor[:, None] * slopes.history_optics.at[history].get(
            mode="promise_in_bounds"
        )
    scored = score[:, :, None] * detach(returned)[:, None, :]
    # All parameters and wavelengths of a bin lie side by side, so that a deposit is one contiguous run.
    rows = outer_rows(detach(row), scored.reshape(first_bin.size, -1))
    flat = tally.reshape(1, len(tally), -1)
    return add_parameter_rows(flat, jnp.zeros_like(first_bin), first_bin, rows)[0].reshape(tally.shape)


def add_parameter_rows(
    tally: Float[Array, "entries bins parameters"],
    tally_row: Int[Array, "rows"],
    first_bin: Int[Array, "rows"],
    rows: Float[Array, "rows kernel parameters"],
) -> Float[Array, "entries bins parameters"]:
    """Add runs of contiguous bins, each with all parameters, to rows of a tally; parameters lie innermost."""
    n_entries, bins, parameters = tally.shape
    flat = add_rows(
        tally.reshape(n_entries, -1), tally_row, first_bin * parameters, rows.reshape(len(rows), -1)
    )
    return flat.reshape(n_entries, bins, parameters)


def with_depth_slopes(
    scene: DeviceScene, segments: RaySegments, w: Vec, stops: list[Scalar]
) -> tuple[RaySegments, list[Float[Array, "rays parameters"]]]:
    """Add derivatives of the depth before each segment; also return those up to `stops`.

    Segment after segment along each ray:

    1. The derivative of the voxel's extinction.
    2. Add to those of the stops what of the segment lies before each, times that derivative.
    3. Keep the sum before the segment, and add the length of the segment times that derivative.
    """
    medium, slopes = scene.medium, scene.slopes
    assert medium is not None
    assert slopes is not None
    # Directions are fixed: only k depends on the parameters.
    projection_factor = detach(medium.projection_factor(w))

    # Along the ray, because the depth before a segment is a running sum. The slopes at stops are those of the
    # segment in which each stop lies.
    def step(carry, segment):
        before, at_stops = carry
        start, length, cell = segment
        parameters, at_cell = slopes.parameters_at(cell), slopes.slopes_at(cell, projection_factor)
        slope = slopes.to_all_parameters(parameters, at_cell, axis=-1)
        to_stops = [jnp.clip(stop - start, 0.0, length)[:, None] for stop in detach(stops)]
        at_stops = [a + slope * to_stop for a, to_stop in zip(at_stops, to_stops)]
        return (before + slope * length[:, None], at_stops), before

    rows = detach((segments.start, segments.length, segments.cell))
    zero = vary_with(jnp.zeros((w[0].size, slopes.count), w[0].dtype), rows)
    (_, at_stops), before = jax.lax.scan(step, (zero, [zero] * len(stops)), rows)
    return dataclasses.replace(segments, depth_slopes=before), at_stops


def segment_derivatives(
    scene: DeviceScene,
    is_leaf: bool,
    w: Vec,
    start_position: Scalar,
    segments: RaySegments,
    kappa: float,
    extinction: Scalar,
    value: Scalar,
) -> Float[Array, "segments pieces parameters"]:
    """Return the derivatives of what leaf, or bark, returns from segments, bin by bin (see the module).

    1. I and dI/dk of every piece, by one tangent.
    2. The slopes of the extinction of all materials, dk, and of the one that returns, d k_m.
    3. The term at fixed I: V_m E (d k_m - kappa k_m d tau_0) times I.
    4. The term of the change of I: V_m E k_m dk times dI/dk.

    `extinction` is that material's k_m, and `value` is V_m E, the intensity factor times the ray's energy.
    """
    medium, slopes, bins = scene.medium, scene.slopes, scene.bins
    assert medium is not None
    assert slopes is not None
    depth_slopes = segments.depth_slopes
    assert depth_slopes is not None
    segments, start_position, extinction, value = detach((segments, start_position, extinction, value))
    projection_factor = detach(medium.projection_factor(w))

    def integrals(k):
        at_k = dataclasses.replace(segments, extinction=k)
        return integrate_over_bins(bins, start_position, at_k, kappa)[1]

    k = segments.extinction
    # One tangent gives dI/dk for all parameters: they act on the integral through the k of the voxel alone.
    pieces, d_pieces_dk = jax.jvp(integrals, (k,), (jnp.ones_like(k),))
    parameters = slopes.parameters_at(segments.cell)
    at_cell = slopes.slopes_at(segments.cell, projection_factor)
    slope = slopes.to_all_parameters(parameters, at_cell, axis=-1)
    # k_m is the extinction of the returning material, k that of both: leaf may change while bark returns.
    material_slopes = slopes.of_material(is_leaf)
    if material_slopes is None:
        material_slope = jnp.zeros_like(slope)
    else:
        at_cell = material_slopes.slopes_at(segments.cell, projection_factor)
        material_slope = material_slopes.to_all_parameters(parameters, at_cell, axis=-1)
    # Both terms of the module's equation: the one at fixed I, and that through dI/dk.
    at_fixed_integral = value[:, None] * (material_slope - (kappa * extinction)[:, None] * depth_slopes)
    return outer_rows(pieces.T, at_fixed_integral) + outer_rows(
        d_pieces_dk.T, (value * extinction)[:, None] * slope
    )


def make_slopes(
    scene: DeviceScene,
    leaf: Float[Array, "parameters cells"] | None,
    bark: Float[Array, "parameters cells"] | None,
    optics: Float[Array, "channels wavelengths"],
    per_voxel: int,
) -> ExtinctionSlopes:
    """Make extinction slopes from d k / d theta; a voxel depends on at most `per_voxel` parameters."""
    medium = scene.medium
    assert medium is not None
    table = leaf if leaf is not None else bark
    assert table is not None
    count = len(table)
    leaf, bark, parameter_index = pack_slopes(leaf, bark, per_voxel)
    history_optics = scene.histories.monomials(optics)
    slopes = ExtinctionSlopes(leaf, bark, parameter_index, None, history_optics, count=count)
    # Off nadir, return paths are marched, and sum their own slopes.
    if scene.depth_above is None:
        return slopes
    return dataclasses.replace(slopes, depth_above=_vertical_slopes(medium, slopes))


def _vertical_slopes(medium: Medium, slopes: ExtinctionSlopes) -> Float[Array, "cells parameters"]:
    """Return the derivatives of the optical depth straight up from each voxel's upper face."""
    nx, ny, nz = medium.shape
    cells = jnp.arange(int(np.prod(medium.shape))).reshape(nx * ny, nz).T
    one = jnp.ones((nx * ny,), medium.size.dtype)
    projection_factor = medium.projection_factor((0.0 * one, 0.0 * one, one))

    def layer(above, cell):
        in_layer = [slope * medium.size[2] for slope in slopes.slopes_at(cell, projection_factor)]
        return above + slopes.to_all_parameters(slopes.parameters_at(cell), in_layer, axis=-1), above

    zero = vary_with(jnp.zeros((nx * ny, slopes.count), medium.size.dtype), medium)
    # From the top down, each layer before its own slope is added: the table is for upper faces.
    _, above = jax.lax.scan(layer, zero, cells, reverse=True)
    return jnp.swapaxes(above, 0, 1).reshape(-1, slopes.count)
