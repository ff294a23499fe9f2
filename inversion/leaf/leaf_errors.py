"""Standard errors of leaf traits that hold PROSPECT's own error, which is correlated over wavelengths.

To first order, spectra that are off by e move a least-squares fit by A e, A = (J'WJ)^-1 J'W. The covariance
of e is that of independent noise plus a model error

    s^2 a(x) a(y) exp(-|x - y| / l),    a = sqrt(c^2 + (k dR/dk)^2),

for wavelengths x and y of reflectance, with transmittance alike and apart: absorption coefficients are off by
a share, and the scattering by a constant. s, l and, where it is not given, the noise follow from the
residuals of the leaf by restricted likelihood, which counts what the fit has taken out of them; the
variances of the traits, A cov(e) A', are averaged over s and l by it. A fit to the bands of a domain starts
from traits that the fit to all bands fixed; their errors enter by the same e.

The likelihood runs over means of neighbouring bands by the Kalman filter of an exponential covariance.

Source: Patterson and Thompson (1971), Biometrika 58, 545 (restricted likelihood); White (1980), Econometrica
48, 817 (A cov(e) A'); Hartikainen and Sarkka (2010), IEEE MLSP, 379 (the filter).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from inversion.leaf.leaf_solver import in_chunks, rounding
from jaxlidar.extend import once
from jaxlidar.optics.leaf_surface import LeafSurface
from jaxlidar.optics.plate_model import plate_model_slopes

# c: most likely on the leaves of the ANGERS database, within a factor of 1.5; c >> 1 is less likely by a
# factor of e^30 a leaf.
_SCATTERING = 0.04
# Lengths l, nm, and variances of the model error over those of the noise.
_LENGTHS = (20.0, 60.0, 200.0, 600.0)
_RATIOS = (0.0, 0.1, 0.5, 2.0, 10.0, 50.0, 300.0, 3000.0)
# Most means of neighbouring bands.
_MEANS = 128
# Smallest eigenvalue of the normal matrix, of unit diagonal, at which a combination counts as determined.
_COLLINEAR = 1e-5


class Stage(NamedTuple):
    """One fit of each leaf: its traits, what its normal matrix determines, and the bands that it used.

    `root` is W with W W' = (J'WJ)^-1 among the unknowns of the fit, zero elsewhere. `link` is the
    derivative of its traits with respect to those that it kept fixed, negative.
    """

    x: Float[Array, "*leaves n"]
    root: Float[Array, "*leaves n n"]
    link: Float[Array, "*leaves n n"]
    bands: Float[Array, "*leaves wavelengths"]


def inverse_root(
    normal: Float[np.ndarray, "leaves n n"],
) -> tuple[Float[np.ndarray, "leaves n n"], Bool[np.ndarray, "leaves n"]]:
    """W with W W' the inverse of the normal matrices, and which traits are not determined."""
    norm = np.sqrt(np.diagonal(normal, axis1=1, axis2=2))
    norm = np.where(norm > 0, norm, 1.0)
    value, vector = np.linalg.eigh(normal / (norm[:, :, None] * norm[:, None, :]))
    known = (value > _COLLINEAR)[:, None, :]
    lost = np.sum(np.where(known, 0.0, vector**2), axis=2) > 1e-3
    root = np.where(known, vector / np.sqrt(np.where(known, value[:, None, :], 1.0)), 0.0)
    return root / norm[:, :, None], lost


def trait_errors(
    wavelengths: Float[np.ndarray, " wavelengths"],
    observed: Float[Array, "leaves 2 wavelengths"],
    sigma: Float[Array, "leaves 2 wavelengths"],
    absorption: Float[Array, "traits wavelengths"],
    face: LeafSurface,
    stages: list[Stage],
    of: Int[np.ndarray, " n"],
    noise_known: bool,
    chunk: int,
) -> Float[Array, "leaves n"]:
    """Standard errors of all traits; the first stage is the fit to all bands; `of`: stage of each trait."""
    # Means are of bands next to one another; the last is filled up with bands that are left out.
    bands = len(wavelengths)
    each = -(-bands // _MEANS)
    order = np.argsort(wavelengths, kind="stable")
    order = np.append(order, np.repeat(order[-1:], -bands % each))
    sigma = jnp.where((np.arange(order.size) < bands)[None, None], sigma[..., order], jnp.inf)
    centre = np.mean(np.reshape(wavelengths[order], (-1, each)), axis=1)
    stacked = jax.tree.map(lambda *a: jnp.stack(a, axis=1), *stages)
    return _errors(
        stacked._replace(bands=stacked.bands[..., order]),
        observed[..., order],
        sigma,
        absorption[:, order],
        LeafSurface(*(x[order] for x in face)),
        jnp.asarray(centre, sigma.dtype),
        jnp.asarray(of),
        noise_known,
        chunk,
    )


@partial(jax.jit, static_argnames=("noise_known", "chunk"))
def _errors(
    stages: Stage,
    observed: Array,
    sigma: Array,
    absorption: Array,
    face: LeafSurface,
    centre: Array,
    of: Array,
    noise_known: bool,
    chunk: int,
) -> Array:
    means, dtype = len(centre), sigma.dtype
    lengths, ratios = (
        jnp.ravel(a) for a in jnp.meshgrid(*map(jnp.array, (_LENGTHS, _RATIOS)), indexing="ij")
    )
    apart = jnp.abs(centre[:, None] - centre[None])
    kernel = jnp.exp(-apart[None] / jnp.asarray(_LENGTHS, dtype)[:, None, None])
    decay = jnp.exp(-jnp.diff(centre, prepend=centre[:1])[:, None] / lengths[None]).astype(dtype)
    dot = partial(jnp.einsum, precision=lax.Precision.HIGHEST)

    def mean_sum(x: Array) -> Array:
        return jnp.sum(x.reshape(*x.shape[:-1], means, -1), axis=-1)

    def jacobian(x: Array) -> tuple[Array, Array, Array]:
        """Spectra (2, bands), their derivatives (n, 2, bands), and k dR/dk."""
        k = dot("i,ij->j", x[1:], absorption) / x[0]
        values, in_k, in_N = (jnp.stack(v[:2]) for v in plate_model_slopes(k, x[0], face))
        # Without the barrier the compiler would compute them again for every sum below.
        values, in_k, in_N = once((values, in_k, in_N))
        in_N = in_N - in_k * k[None] / x[0]
        rest = absorption[:, None] * in_k[None] / x[0]
        return values, jnp.concatenate([in_N[None], rest]), in_k * k[None]

    def one(leaf: tuple[Stage, Array, Array]) -> Array:
        stage, observed, sigma = leaf
        used = jnp.isfinite(observed) & jnp.isfinite(sigma)
        weight = jnp.where(used, 1.0 / sigma**2, 0.0)
        values, slopes, in_k = jax.vmap(jacobian)(stage.x)
        gain = dot("sij,skj,skcl->sicl", stage.root, stage.root, slopes * stage.bands[:, None, None])
        gain = gain * weight[None, None]
        gain = gain - dot("sij,jcl->sicl", stage.link, gain[0])
        gain = gain[of, jnp.arange(len(of))]

        amplitude = jnp.where(used, jnp.sqrt(_SCATTERING**2 + in_k[0] ** 2), 0.0)
        # The ratio of a sample's variances times the mean of noise over that of amplitudes, squared.
        scale = jnp.sum(jnp.where(used, sigma, 0.0) ** 2) / jnp.maximum(jnp.sum(amplitude**2), 1e-9)
        strength = (ratios * scale).astype(dtype)

        total = mean_sum(weight)
        noise = jnp.where(total > 0, 1.0 / jnp.where(total > 0, total, 1.0), jnp.inf)
        residual = jnp.where(used, observed - values[0], 0.0)
        columns = jnp.concatenate([dot("ij,icl->jcl", stage.root[0], slopes[0]), residual[None]])
        share = jnp.where(total > 0, noise, 0.0)
        white, volume = _whiten(
            mean_sum(columns * weight[None]) * share[None],
            mean_sum(amplitude * weight) * share,
            noise,
            decay,
            strength,
        )
        white = white.transpose(1, 2, 0, 3).reshape(len(lengths), len(columns), -1)
        product = dot("git,gjt->gij", white, white)
        known = jnp.any(stage.root[0] != 0, axis=0)
        normal = product[:, :-1, :-1] + jnp.diag(jnp.where(known, 0.0, 1.0))[None]
        root = jnp.linalg.cholesky(normal)
        fitted = jax.scipy.linalg.solve_triangular(root, product[:, :-1, -1:], lower=True)
        square = product[:, -1, -1] - jnp.sum(fitted**2, axis=(1, 2))
        freedom = jnp.maximum(jnp.sum(total > 0) - jnp.sum(known), 1)
        volume = volume + 2 * jnp.sum(jnp.log(jnp.diagonal(root, axis1=1, axis2=2)), axis=1)
        if noise_known:
            variance, likelihood = jnp.ones_like(square), -0.5 * (square + volume)
        else:
            variance = jnp.maximum(square / freedom, rounding(dtype) ** 2)
            likelihood = -0.5 * (freedom * jnp.log(variance) + volume)
        odds = jax.nn.softmax(likelihood)

        summed = mean_sum(gain * amplitude[None])
        smooth = jnp.sum(dot("ict,etu->eicu", summed, kernel) * summed[None], axis=(2, 3))
        smooth = jnp.repeat(smooth, len(_RATIOS), axis=0) * strength[:, None]
        independent = jnp.sum(gain**2 * jnp.where(used, sigma, 0.0)[None] ** 2, axis=(1, 2))
        spread = dot("g,gi->i", odds * variance, smooth + independent[None])
        return jnp.sqrt(spread)

    return in_chunks(one, (stages, observed, sigma), chunk)


def _whiten(
    columns: Float[Array, "columns 2 means"],
    amplitude: Float[Array, "2 means"],
    noise: Float[Array, "2 means"],
    decay: Float[Array, "means grid"],
    strength: Float[Array, " grid"],
) -> tuple[Float[Array, "means grid columns 2"], Float[Array, " grid"]]:
    """The columns times the inverse root of their covariance, and the logarithm of its determinant."""

    def step(state: tuple[Array, Array], at: tuple[Array, ...]) -> tuple[Any, Any]:
        mean, spread = state
        y, a, r, rho = at
        spread = 1.0 + rho[:, None] ** 2 * (spread - 1.0)
        mean = rho[:, None, None] * mean
        h = jnp.sqrt(strength)[:, None] * a[None]
        variance = h**2 * spread + r[None]
        ahead = y[None] - h[:, None] * mean
        pull = spread * h / variance
        state = (mean + pull[:, None] * ahead, spread * (1.0 - pull * h))
        log = jnp.where(jnp.isfinite(r)[None], jnp.log(variance), 0.0)
        return state, (ahead / jnp.sqrt(variance)[:, None], jnp.sum(log, axis=1))

    grid, dtype = len(strength), columns.dtype
    first = (jnp.zeros((grid, len(columns), 2), dtype), jnp.ones((grid, 2), dtype))
    data = (columns.transpose(2, 0, 1), amplitude.T, noise.T, decay)
    _, (white, log) = lax.scan(step, first, data)
    return white, jnp.sum(log, axis=0)
