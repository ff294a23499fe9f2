r"""Standard errors of leaf traits that include PROSPECT's own error, which is correlated over wavelengths.

**Estimator.** To first order, spectra that are off by e move a least-squares fit by A e, with the gain matrix
A = (J'WJ)^-1 J'W. The covariance of the traits is A cov(e) A' (White 1980).

**Model error.** cov(e) is independent noise plus, between wavelengths u and v of reflectance,

    s^2 a(u) a(v) exp(-|u - v| / l),    a = sqrt(c^2 + (k dR/dk)^2),

and the same for transmittance, independent of reflectance: absorption coefficients are off by a fraction, and
the scattering by a constant.

**Restricted likelihood.** s, l and, where it is not given, the noise follow from the residuals r of the leaf.
With V the covariance in units of the noise's variance q, f degrees of freedom and X the columns that the fit
has taken out of the residuals (Patterson and Thompson 1971),

    -2 ln L = f ln q + ln |V| + ln |X' V^-1 X|,    q = r' P r / f,
    P = V^-1 - V^-1 X (X' V^-1 X)^-1 X' V^-1.

If the noise is given, q is one and -2 ln L = r' P r + ln |V| + ln |X' V^-1 X|. The variances of the traits
are averaged with the weight L over a grid of s and l.

**Whitening.** V^-1/2 and |V| of an exponential covariance plus noise take one pass of a Kalman filter over
wavelengths (Hartikainen and Sarkka 2010), here over means of neighbouring bands.

**Stages.** A fit to the bands of a domain starts from traits that the fit to all bands fixed; their errors
enter by the same e: A_domain = (J'WJ)^-1 J'W - link A_all.

**Source:** Patterson and Thompson (1971), Biometrika 58, 545; White (1980), Econometrica 48, 817;
Hartikainen and Sarkka (2010), IEEE MLSP, 379.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from inversion.leaf.solver import map_in_chunks, residual_rounding
from jaxlidar.extend import barrier, einsum
from jaxlidar.optics.leaf_surface import LeafSurface
from jaxlidar.optics.plate_model import plate_model_slopes

# c: most likely on the leaves of the ANGERS database, within a factor of 1.5; c >> 1 is less likely by a
# factor of e^30 a leaf.
_SCATTERING = 0.04
# Grid of lengths l, nm, and of variances of the model error over that of the noise.
_LENGTHS = (20.0, 60.0, 200.0, 600.0)
_RATIOS = (0.0, 0.1, 0.5, 2.0, 10.0, 50.0, 300.0, 3000.0)
# Bands, nm, in which leaves are opaque: blue, by pigments, and the strongest band of water.
_OPAQUE_BANDS = ((440.0, 460.0), (1925.0, 1955.0))
# Largest number of means of neighbouring bands.
_MEANS = 128
# Smallest eigenvalue of the normal matrix, of unit diagonal, of a combination of traits that is determined.
_COLLINEAR = 1e-5
# A trait with more than this of its square in combinations that are not determined is itself not determined.
_UNDETERMINED_FRACTION = 1e-3


class LinearisedFit(NamedTuple):
    """Linearisation of one fit of each leaf about its traits.

    - `x`: N and contents.
    - `root`: B with B B' = (J'WJ)^-1 among the unknowns of the fit, zero elsewhere.
    - `link`: minus the derivative of its traits with respect to those that it kept fixed.
    - `bands`: one for the wavelengths that it used, zero for others.
    """

    x: Float[Array, "*leaves n"]
    root: Float[Array, "*leaves n n"]
    link: Float[Array, "*leaves n n"]
    bands: Float[Array, "*leaves wavelengths"]


def inverse_root(
    normal: Float[np.ndarray, "leaves n n"],
) -> tuple[Float[np.ndarray, "leaves n n"], Bool[np.ndarray, "leaves n"]]:
    """Return B with B B' the inverse of normal matrices, and True for traits that are not determined.

    Eigenvectors of the matrix, scaled to unit diagonal, over the roots of their eigenvalues; combinations of
    traits with tiny eigenvalues are left out.
    """
    norm = np.sqrt(np.diagonal(normal, axis1=1, axis2=2))
    norm = np.where(norm > 0, norm, 1.0)
    eigenvalues, eigenvectors = np.linalg.eigh(normal / (norm[:, :, None] * norm[:, None, :]))
    is_determined = (eigenvalues > _COLLINEAR)[:, None, :]
    is_undetermined = np.sum(np.where(is_determined, 0.0, eigenvectors**2), axis=2) > _UNDETERMINED_FRACTION
    scale = np.sqrt(np.where(is_determined, eigenvalues[:, None, :], 1.0))
    root = np.where(is_determined, eigenvectors / scale, 0.0)
    return root / norm[:, :, None], is_undetermined


def trait_errors(
    wavelengths: Float[np.ndarray, " wavelengths"],
    observed: Float[Array, "leaves 2 wavelengths"],
    sigma: Float[Array, "leaves 2 wavelengths"],
    absorption: Float[Array, "contents wavelengths"],
    surface: LeafSurface,
    fits: list[LinearisedFit],
    fit_of_trait: Int[np.ndarray, " n"],
    noise_is_given: bool,
    chunk: int,
) -> tuple[Float[Array, "leaves n"], Float[np.ndarray, " leaves"]]:
    """Return standard errors of all traits, and the light that passed leaves through gaps.

    The latter is the mean transmittance beyond that of the fit to all bands, in blue light and in the water
    band, whichever is less; zero where a leaf lacks the bands or the transmittance. No leaf lets as much
    light through in both, and light through gaps has no colour.

    **Arguments:**

    - `wavelengths`, `observed`, `sigma`, `absorption`, `surface`, `chunk`: as for `fit_leaves`.
    - `fits`: the fits of each leaf; the first one is the fit to all bands.
    - `fit_of_trait`: index of the fit that gave each trait.
    - `noise_is_given`: False if `sigma` is known up to a factor.
    """
    # Means are of bands next to one another, in the order of wavelengths. The last mean is filled up with
    # bands of infinite noise, which have no weight.
    n_bands = len(wavelengths)
    bands_per_mean = -(-n_bands // _MEANS)
    order = np.argsort(wavelengths, kind="stable")
    order = np.append(order, np.repeat(order[-1:], -n_bands % bands_per_mean))
    sigma = jnp.where((np.arange(order.size) < n_bands)[None, None], sigma[..., order], jnp.inf)
    centre = np.mean(np.reshape(wavelengths[order], (-1, bands_per_mean)), axis=1)
    stacked = jax.tree.map(lambda *arrays: jnp.stack(arrays, axis=1), *fits)
    is_opaque = np.stack([(wavelengths >= low) & (wavelengths <= high) for low, high in _OPAQUE_BANDS])
    errors, gap_light = _trait_errors(
        stacked._replace(bands=stacked.bands[..., order]),
        observed[..., order],
        sigma,
        absorption[:, order],
        LeafSurface(*(x[order] for x in surface)),
        jnp.asarray(centre, sigma.dtype),
        jnp.asarray(fit_of_trait),
        # Bands that fill up the last mean are used by no leaf.
        jnp.asarray(is_opaque[:, order], sigma.dtype),
        noise_is_given,
        chunk,
    )
    return errors, np.asarray(gap_light)


@partial(jax.jit, static_argnames=("noise_is_given", "chunk"))
def _trait_errors(
    fits: LinearisedFit,
    observed: Array,
    sigma: Array,
    absorption: Array,
    surface: LeafSurface,
    centre: Array,
    fit_of_trait: Array,
    is_opaque: Array,
    noise_is_given: bool,
    chunk: int,
) -> tuple[Array, Array]:
    """Standard errors of all traits, (leaves, n), and light through gaps, (leaves,): see `trait_errors`.

    Bands are sorted by wavelength.

    For each leaf, in numbered steps below:

    1. Gain matrix A of the fit that gave each trait.
    2. Amplitude a of the model error.
    3. Means of residuals and of the columns X over neighbouring bands, whitened for every (l, s) of the grid.
    4. Restricted likelihood of each (l, s).
    5. A cov(e) A' for each (l, s), averaged by likelihood.

    `centre`: (means,) wavelengths of the means, nm.
    """
    n_means, dtype = len(centre), sigma.dtype
    lengths, ratios = (
        jnp.ravel(a) for a in jnp.meshgrid(*map(jnp.array, (_LENGTHS, _RATIOS)), indexing="ij")
    )
    distance = jnp.abs(centre[:, None] - centre[None])
    correlation = jnp.exp(-distance[None] / jnp.asarray(_LENGTHS, dtype)[:, None, None])
    # Correlation of each mean with the one before.
    decay = jnp.exp(-jnp.diff(centre, prepend=centre[:1])[:, None] / lengths[None]).astype(dtype)

    def sum_in_means(x: Array) -> Array:
        """Sum the last axis over the bands of each mean."""
        return jnp.sum(x.reshape(*x.shape[:-1], n_means, -1), axis=-1)

    def spectra_with_jacobian(x: Array) -> tuple[Array, Array, Array]:
        """Spectra (2, bands), their derivatives (n, 2, bands), and k dR/dk (2, bands)."""
        k = einsum("i,ij->j", x[1:], absorption) / x[0]
        values, dR_dk, dR_dN = (jnp.stack(v[:2]) for v in plate_model_slopes(k, x[0], surface))
        # Optimisation barrier: without it the compiler would compute the model again for every sum below.
        values, dR_dk, dR_dN = barrier((values, dR_dk, dR_dN))
        N_column = dR_dN - dR_dk * k[None] / x[0]
        content_columns = absorption[:, None] * dR_dk[None] / x[0]
        return values, jnp.concatenate([N_column[None], content_columns]), dR_dk * k[None]

    def errors_of_leaf(leaf: tuple[LinearisedFit, Array, Array]) -> tuple[Array, Array]:
        fit, observed, sigma = leaf
        is_used = jnp.isfinite(observed) & jnp.isfinite(sigma)
        weight = jnp.where(is_used, 1.0 / sigma**2, 0.0)

        # 1. Gain of every fit, (fits, n, 2, bands), and of the fit that gave each trait, (n, 2, bands).
        values, jacobian, k_dR_dk = jax.vmap(spectra_with_jacobian)(fit.x)
        fitted_jacobian = jacobian * fit.bands[:, None, None]
        gain = einsum("sij,skj,skcl->sicl", fit.root, fit.root, fitted_jacobian)
        gain = gain * weight[None, None]
        gain = gain - einsum("sij,jcl->sicl", fit.link, gain[0])
        gain = gain[fit_of_trait, jnp.arange(len(fit_of_trait))]

        # 2. Amplitude, and the strengths s^2 that make the model's mean variance that of the noise times the
        # ratios.
        amplitude = jnp.where(is_used, jnp.sqrt(_SCATTERING**2 + k_dR_dk[0] ** 2), 0.0)
        noise_sum = jnp.sum(jnp.where(is_used, sigma, 0.0) ** 2)
        scale = noise_sum / jnp.maximum(jnp.sum(amplitude**2), 1e-9)
        strength = (ratios * scale).astype(dtype)

        # 3. Weighted means: residuals in the last column, before them the columns X = J B.
        mean_weight = sum_in_means(weight)
        has_weight = mean_weight > 0
        mean_variance = jnp.where(has_weight, 1.0 / jnp.where(has_weight, mean_weight, 1.0), jnp.inf)
        residual = jnp.where(is_used, observed - values[0], 0.0)
        fit_columns = einsum("ij,icl->jcl", fit.root[0], jacobian[0])
        columns = jnp.concatenate([fit_columns, residual[None]])
        normalise = jnp.where(has_weight, mean_variance, 0.0)
        whitened, log_determinant = _whiten(
            sum_in_means(columns * weight[None]) * normalise[None],
            sum_in_means(amplitude * weight) * normalise,
            mean_variance,
            decay,
            strength,
        )
        whitened = whitened.transpose(1, 2, 0, 3).reshape(len(lengths), len(columns), -1)

        # 4. X' V^-1 X, X' V^-1 r and r' V^-1 r are the blocks of one product.
        product = einsum("git,gjt->gij", whitened, whitened)
        is_fitted = jnp.any(fit.root[0] != 0, axis=0)
        # Columns of traits that are fixed or not determined are zero; one on the diagonal leaves them out.
        normal = product[:, :-1, :-1] + jnp.diag(jnp.where(is_fitted, 0.0, 1.0))[None]
        cholesky = jnp.linalg.cholesky(normal)
        explained = jax.scipy.linalg.solve_triangular(cholesky, product[:, :-1, -1:], lower=True)
        square = product[:, -1, -1] - jnp.sum(explained**2, axis=(1, 2))
        degrees_of_freedom = jnp.maximum(jnp.sum(has_weight) - jnp.sum(is_fitted), 1)
        log_normal = 2 * jnp.sum(jnp.log(jnp.diagonal(cholesky, axis1=1, axis2=2)), axis=1)
        log_determinant = log_determinant + log_normal
        if noise_is_given:
            variance, log_likelihood = jnp.ones_like(square), -0.5 * (square + log_determinant)
        else:
            variance = jnp.maximum(square / degrees_of_freedom, residual_rounding(dtype) ** 2)
            log_likelihood = -0.5 * (degrees_of_freedom * jnp.log(variance) + log_determinant)
        probability = jax.nn.softmax(log_likelihood)

        # 5. The correlated part of A cov(e) A' by means; the independent part by bands.
        mean_gain = sum_in_means(gain * amplitude[None])
        correlated = jnp.sum(einsum("ict,etu->eicu", mean_gain, correlation) * mean_gain[None], axis=(2, 3))
        # The grid runs through all ratios for each length.
        correlated = jnp.repeat(correlated, len(_RATIOS), axis=0) * strength[:, None]
        independent = jnp.sum(gain**2 * jnp.where(is_used, sigma, 0.0)[None] ** 2, axis=(1, 2))
        trait_variance = einsum("g,gi->i", probability * variance, correlated + independent[None])

        # Residuals of transmittance are zero where there is no sample.
        n_opaque = jnp.sum(is_opaque * is_used[1][None], axis=1)
        excess = jnp.sum(is_opaque * residual[1][None], axis=1) / jnp.maximum(n_opaque, 1)
        return jnp.sqrt(trait_variance), jnp.min(excess)

    return map_in_chunks(errors_of_leaf, (fits, observed, sigma), chunk)


def _whiten(
    columns: Float[Array, "columns 2 means"],
    amplitude: Float[Array, "2 means"],
    noise: Float[Array, "2 means"],
    decay: Float[Array, "means grid"],
    strength: Float[Array, " grid"],
) -> tuple[Float[Array, "means grid columns 2"], Float[Array, " grid"]]:
    """Multiply columns by the inverse root of their covariance; return its log determinant too.

    The model error is a process u of unit variance with correlation rho between neighbouring means, observed
    as y = h u + noise of variance R, with h = s a. For each mean:

    1. Predict: m <- rho m, P <- 1 + rho^2 (P - 1), the mean and variance of u.
    2. Innovation y - h m, of variance S = h^2 P + R; divided by sqrt(S) it is the whitened value, and ln S
       adds up to the log determinant.
    3. Update: m <- m + K (y - h m), P <- P (1 - K h), with the gain K = P h / S.

    **Arguments:** `noise`: variances of the means, infinite for means without weight. `decay`: rho of each
    mean with the one before. `strength`: s^2.
    """

    def filter_mean(state: tuple[Array, Array], inputs: tuple[Array, ...]) -> tuple[Any, Any]:
        m, P = state
        y, a, R, rho = inputs
        P = 1.0 + rho[:, None] ** 2 * (P - 1.0)
        m = rho[:, None, None] * m
        h = jnp.sqrt(strength)[:, None] * a[None]
        S = h**2 * P + R[None]
        innovation = y[None] - h[:, None] * m
        kalman_gain = P * h / S
        state = (m + kalman_gain[:, None] * innovation, P * (1.0 - kalman_gain * h))
        log_variance = jnp.where(jnp.isfinite(R)[None], jnp.log(S), 0.0)
        return state, (innovation / jnp.sqrt(S)[:, None], jnp.sum(log_variance, axis=1))

    grid, dtype = len(strength), columns.dtype
    start = (jnp.zeros((grid, len(columns), 2), dtype), jnp.ones((grid, 2), dtype))
    inputs = (columns.transpose(2, 0, 1), amplitude.T, noise.T, decay)
    _, (whitened, log_variances) = lax.scan(filter_mean, start, inputs)
    return whitened, jnp.sum(log_variances, axis=0)
