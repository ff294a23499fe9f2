r"""Covariance of the estimates of a fit: of the noise, of the simulation, and robust to misfit.

**Notation.** J: whitened Jacobian of the data (data, n); P: precision of the priors; H = J^T J + P: the
posterior precision, whose inverse is the posterior covariance of the linearised problem. J^T J alone is the
Fisher information.

**Stated noise and simulation.** Residuals are whitened by the noise of measurement and simulation together.
The covariance of the estimates is

    H^-1 (J^T W J + P) H^-1  +  (covariance of H^-1 J^T d over batches) / (number of batches),

with W the diagonal fraction of the variance that is the measurement's, and d the deviations of the
simulation's batches from their mean. W is exact for independent samples; with correlated or shared errors,
where whitened samples are mixtures, it is an approximation. The second term is the simulation's own noise. As
all batches of all samples enter it together, it has the full correlation between bins and wavelengths, which
W alone would miss.

**Share of the prior.** A = H^-1 J^T J = d estimate / d truth is the averaging kernel. The share of the prior
in an estimate is 1 - A_ii, the diagonal of H^-1 P, cut to [0, 1], which it may leave if unknowns are
correlated.

**Unknowns at their bounds.** An estimate at its bound stays there when the truth changes a little, and the
others are then fitted with it held. With F the free unknowns and B those at a bound, the averaging kernel is

    A_F = (H_FF)^-1 (J^T J)_F,    A_B = 0,

so that unknowns at their bounds have no degrees of freedom for signal. (H_FF)^-1 is the covariance of the
free unknowns at known ones, S_FF - S_FB S_BB^-1 S_BF with S = H^-1. Shares of the prior and standard errors
are those without bounds: an estimate at its bound has an error.

**Undetermined unknowns.** An unknown is undetermined if its standard error, from data and priors, exceeds the
width of its bounds, alone or in combination with others: eigenvectors of H, scaled to a unit diagonal, whose
eigenvalue is rounding.

**Misfit.** A wrong model leaves residuals that are large where the signal is, and alike from sample to
sample. The whitened residuals of a fit are taken as a draw from

    C_ij = a^2 (delta_ij + k^2 g_i g_j phi^|i - j|),    g_i = s_i / max s,

with s the modelled record in the same units, without offsets of digitisers: white noise of amplitude a, and
an error of the model that is k times as large at the signal's peak, proportional to the signal, first-order
autoregressive over samples, and independent between wavelengths. Each phi and k of a grid is weighted by the
restricted likelihood of the residuals (the unknowns are integrated out, which accounts for the degrees of
freedom that they took; a has its value of largest likelihood). With C the mean over the grid, the robust
covariance is the sandwich

    H^-1 (J^T C J + P) H^-1.

Short records determine phi and k poorly, and the mean over the grid is then on the safe side: with noise
only, robust errors are up to twice the plain ones. Errors of the model that the unknowns absorb without a
trace, such as an offset of the clock, remain hidden.

**Source:** restricted likelihood: Patterson and Thompson (1971), Biometrika 58, 545; sandwich: White (1980),
Econometrica 48, 817; averaging kernel: Rodgers (2000), Inverse Methods for Atmospheric Sounding, chapter 2;
Newton decrement: Boyd and Vandenberghe (2004), Convex Optimization, section 9.5.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

# Smallest eigenvalue of H, scaled to a unit diagonal, at which a combination of unknowns counts as
# determined.
_MIN_EIGENVALUE = 1e-6
# An unknown with more than this squared component in an undetermined combination is undetermined.
_MIN_COMPONENT = 1e-3
# Grids of phi and k^2.
_PHI_GRID = (0.0, 0.5, 0.8, 0.92, 0.97)
_K2_GRID = (0.0, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
# With fewer degrees of freedom residuals do not determine a covariance.
_MIN_DEGREES_OF_FREEDOM = 8.0
# Added to the unit diagonal of the scaled information: keeps it regular for collinear unknowns.
_RIDGE = 1e-12


class EstimateCovariance(NamedTuple):
    """Covariance of the unknowns in natural units.

    - `covariance`: of all unknowns. Undetermined ones have an infinite variance and no covariance with
      others, whose covariance is as if the undetermined ones were free.
    - `simulation_error`: standard errors from the simulation's noise alone.
    - `is_undetermined`: True for unknowns that neither data nor priors constrain to within their bounds.
    - `inverse_information`: H^-1; zero for undetermined combinations.
    - `prior_share`: 1 - A_ii, cut to [0, 1]: from 0 (all from the data) to 1 (all from the prior).
    - `averaging`: A, with unknowns at their bounds held there.
    """

    covariance: Float[np.ndarray, "n n"]
    simulation_error: Float[np.ndarray, " n"]
    is_undetermined: np.ndarray
    inverse_information: Float[np.ndarray, "n n"]
    prior_share: Float[np.ndarray, " n"]
    averaging: Float[np.ndarray, "n n"]


def estimate_covariance(
    jacobian: Float[np.ndarray, "data n"],
    precision: Float[np.ndarray, "n n"],
    width: Float[np.ndarray, " n"],
    measurement_fraction: Float[np.ndarray, " data"],
    deviations: Float[np.ndarray, "batches data"] | None,
    basis: Float[np.ndarray, "n n"] | None = None,
    at_bound: Bool[np.ndarray, " n"] | None = None,
) -> EstimateCovariance:
    """Return the covariance at the solution.

    1. Form H in the basis of the priors.
    2. Mark unknowns with less information than a flat prior over their bounds.
    3. Invert H of the others, scaled to a unit diagonal. Leave out eigenvectors of tiny eigenvalue, and mark
       the unknowns in them.
    4. Form the sandwich with the measurement's part.
    5. Add the covariance from the batches of the simulation.
    6. Mark unknowns whose error exceeds the width of their bounds.

    **Arguments:**

    - `jacobian`: whitened, in natural units.
    - `precision`: matrix of the priors, 0 without priors.
    - `width`: of the bounds.
    - `measurement_fraction`: measurement variance over the variance used for whitening.
    - `deviations`: of each batch from their mean, whitened, or None.
    - `basis`: columns in which a prior that correlates unknowns is the identity; such a prior's P alone is
      too ill-conditioned to invert. Default None: no such prior.
    - `at_bound`: True for unknowns at one of their bounds. Default None: none is.
    """
    n = width.size
    basis = np.eye(n) if basis is None else basis
    data_information = jacobian.T @ jacobian
    information = basis.T @ (data_information + precision) @ basis
    # Unknowns with less information than a flat prior over their bounds. Columns of a correlating prior have
    # an information of one or more from the prior, but for rounding (1e-6), and are never marked here: the
    # index of a marked column is that of its unknown.
    is_mixed = np.any(basis != np.diag(np.diag(basis)), axis=0)
    # A prior as wide as the bounds has the information one, but for rounding, and counts as determined.
    is_undetermined = np.diag(information) * np.where(is_mixed, 1.0, width) ** 2 < 1.0 - 1e-6
    prior_information = np.diag(precision)
    marginal_fraction = prior_information / np.where(
        prior_information > 0, prior_information + np.diag(data_information), 1.0
    )
    # Pseudo-inverse, for a unit diagonal so that units of unknowns do not matter.
    candidates = np.flatnonzero(~is_undetermined)
    block = np.ix_(candidates, candidates)
    norm = np.sqrt(np.diag(information)[candidates])
    eigenvalue, eigenvector = np.linalg.eigh(information[block] / np.outer(norm, norm))
    is_regular = eigenvalue > _MIN_EIGENVALUE
    is_undetermined[candidates] |= np.any(eigenvector[:, ~is_regular] ** 2 > _MIN_COMPONENT, axis=1)
    inverse = np.zeros((n, n))
    inverse[block] = (
        (eigenvector[:, is_regular] / eigenvalue[is_regular])
        @ eigenvector[:, is_regular].T
        / np.outer(norm, norm)
    )
    inverse = basis @ inverse @ basis.T
    # The inverse lacks undetermined combinations: of their unknowns, information without correlations counts.
    prior_share = np.where(is_undetermined, marginal_fraction, np.diag(inverse @ precision))
    meat = (jacobian.T * measurement_fraction) @ jacobian + precision
    covariance = inverse @ meat @ inverse
    simulation = np.zeros((n, n))
    if deviations is not None and len(deviations) > 1:
        # Change of the estimates by each batch; the variance of their mean.
        shifts = deviations @ jacobian @ inverse
        simulation = shifts.T @ shifts / (len(shifts) * (len(shifts) - 1))
    covariance = covariance + simulation
    # Again, with the noise of the simulation and the covariance of determined combinations.
    is_undetermined |= np.diag(covariance) > width**2
    covariance[is_undetermined, :] = 0.0
    covariance[:, is_undetermined] = 0.0
    # Twice the same mask picks elements of the diagonal only.
    covariance[is_undetermined, is_undetermined] = np.inf
    simulation_error = np.where(is_undetermined, 0.0, np.sqrt(np.diag(simulation)))
    return EstimateCovariance(
        covariance,
        simulation_error,
        is_undetermined,
        inverse,
        np.clip(prior_share, 0.0, 1.0),
        _covariance_at_bounds(inverse, at_bound) @ data_information,
    )


def _covariance_at_bounds(
    inverse: Float[np.ndarray, "n n"], at_bound: Bool[np.ndarray, " n"] | None
) -> Float[np.ndarray, "n n"]:
    """Return the covariance with the unknowns at a bound known: their rows and columns are zero."""
    if at_bound is None or not np.any(at_bound):
        return inverse
    held = np.flatnonzero(at_bound)
    # Rows of undetermined unknowns are zero already, which makes the block singular.
    gain = inverse[:, held] @ np.linalg.pinv(inverse[np.ix_(held, held)], hermitian=True)
    conditional = inverse - gain @ inverse[held]
    # Zero but for rounding.
    conditional[held] = 0.0
    conditional[:, held] = 0.0
    return conditional


def correlation_of(covariance: Any) -> Any:
    """Return the correlation matrices (..., n, n) of covariances, arrays of NumPy or of JAX.

    Unknowns of infinite or zero variance are uncorrelated with others.
    """
    xp = jnp if isinstance(covariance, jax.Array) else np
    std = xp.sqrt(xp.diagonal(covariance, axis1=-2, axis2=-1))
    is_regular = xp.isfinite(std) & (std > 0)
    safe_std = xp.where(is_regular, std, 1.0)
    are_regular = is_regular[..., :, None] & is_regular[..., None, :] & xp.isfinite(covariance)
    correlation = xp.where(are_regular, covariance, 0.0) / (safe_std[..., :, None] * safe_std[..., None, :])
    is_diagonal = xp.broadcast_to(xp.eye(std.shape[-1], dtype=bool), correlation.shape)
    return xp.where(is_diagonal, 1.0, correlation)


class ResidualCovariance(NamedTuple):
    """Covariance C of the residuals of a fit, as the sandwich needs it.

    - `meat`: J^T C J, the middle of the sandwich.
    - `independent_samples`: number of independent samples with the information of the correlated ones,
      (tr C)^2 / tr C^2.
    """

    meat: Float[np.ndarray, "n n"]
    independent_samples: float


class SampleIndex(NamedTuple):
    """Index of the wavelength, and of the bin, of each sample."""

    wavelength: Int[np.ndarray, " data"]
    bin: Int[np.ndarray, " data"]


def residual_covariance(
    residual: Float[np.ndarray, " data"],
    jacobian: Float[np.ndarray, "data n"],
    precision: Float[np.ndarray, "n n"],
    n_determined: float,
    signal: Float[np.ndarray, " data"],
    index: SampleIndex,
) -> ResidualCovariance:
    """Estimate the covariance of the residuals of a fit by restricted likelihood: see the module.

    1. For each (phi, k^2) of the grid, form M^T C^-1 M and ln det C, with M = (J, r) and a = 1.
    2. Its Cholesky factor, with the priors' precision added (for the unknowns only: the priors are centred on
       the estimates), gives in its last diagonal element the norm of what the unknowns leave of r, hence a^2
       and the restricted likelihood.
    3. Average J^T C J and the effective number of samples with the likelihoods as weights.

    **Arguments:**

    - `residual`, `jacobian`: whitened by the stated noise.
    - `precision`: matrix of the priors, 0 without priors.
    - `n_determined`: effective number of parameters that the data determine (degrees of freedom for signal).
    - `signal`: modelled record without offsets, in standard deviations of the stated noise.
    - `index`: wavelength and bin of each sample, in row-major order.

    **Returns:** the covariance; that of the stated noise for too few degrees of freedom.
    """
    degrees_of_freedom = residual.size - n_determined
    if degrees_of_freedom < _MIN_DEGREES_OF_FREEDOM or not np.any(residual):
        return ResidualCovariance(jacobian.T @ jacobian, float(residual.size))
    columns = np.column_stack([jacobian, residual])
    # Unit columns: units of unknowns do not matter.
    norm = np.linalg.norm(columns, axis=0)
    norm = np.where(norm > 1e-100, norm, 1.0)
    columns = columns / norm
    prior_information = np.pad(precision, (0, 1)) / np.outer(norm, norm) + _RIDGE * np.eye(norm.size)
    relative_signal = np.abs(signal) / max(np.max(np.abs(signal)), 1e-300)
    phi, k2 = (a.ravel() for a in np.meshgrid(_PHI_GRID, _K2_GRID, indexing="ij"))
    order = _sample_order(index)
    product, log_determinant = _whitened_products(columns, relative_signal, k2, phi, order)
    # The last column is r. Its diagonal element is what is left of r once all columns of J are projected out;
    # the elements before it are those of the information on the unknowns.
    cholesky = np.linalg.cholesky(product + prior_information)
    diagonal = np.diagonal(cholesky, axis1=1, axis2=2)
    a2 = (diagonal[:, -1] * norm[-1]) ** 2 / degrees_of_freedom
    # The last term is ln det of the posterior precision of the unknowns.
    minus_two_log_likelihood = (
        log_determinant + degrees_of_freedom * np.log(a2) + 2.0 * np.sum(np.log(diagonal[:, :-1]), axis=1)
    )
    weight = np.exp(-0.5 * (minus_two_log_likelihood - minus_two_log_likelihood.min()))
    weight /= np.sum(weight)
    correlated = _autoregressive_products(relative_signal[:, None] * columns[:, :-1], phi, order)
    white = columns[:, :-1].T @ columns[:, :-1]
    meat = np.sum(weight * a2) * white + np.einsum("cdg,g->cd", correlated, weight * a2 * k2)
    # tr C and tr C^2, with a = 1.
    power = (relative_signal**2)[:, None]
    trace = residual.size + k2 * np.sum(power)
    trace_of_square = residual.size + 2.0 * k2 * np.sum(power)
    trace_of_square = trace_of_square + k2**2 * _autoregressive_products(power, phi**2, order)[0, 0]
    independent_samples = float(weight @ (trace**2 / trace_of_square))
    return ResidualCovariance(meat * np.outer(norm[:-1], norm[:-1]), independent_samples)


class _SampleOrder(NamedTuple):
    """Order in which a filter visits samples. Wavelengths are independent, and visited side by side.

    - `visits`: indices of the first sample of each wavelength, of the second, and so on.
    - `gap`: bins from a sample to the one before it; 0 for the first of a wavelength.
    """

    visits: list[Int[np.ndarray, " wavelengths"]]
    gap: Int[np.ndarray, " data"]

    def correlation_with_previous(self, visit: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """Return (wavelengths, grid) correlation of samples with those before."""
        gap = self.gap[visit, None]
        return np.where(gap > 0, phi**gap, 0.0)


def _sample_order(index: SampleIndex) -> _SampleOrder:
    wavelength, sample_bin = index
    _, first, count = np.unique(wavelength, return_index=True, return_counts=True)
    # Wavelengths with most samples first: those that have samples left at a visit are then a leading slice.
    order = np.argsort(-count, kind="stable")
    first, count = first[order], count[order]
    visits = [first[: np.searchsorted(-count, -visit)] + visit for visit in range(count[0])]
    gap = np.append(0, np.where(np.diff(wavelength) == 0, np.diff(sample_bin), 0))
    return _SampleOrder(visits, gap)


def _whitened_products(
    columns: np.ndarray, relative_signal: np.ndarray, k2: np.ndarray, phi: np.ndarray, order: _SampleOrder
) -> tuple[np.ndarray, np.ndarray]:
    """Return columns^T C^-1 columns (grid, columns, columns), and ln det C, for a = 1: by a Kalman filter.

    The state is the autoregressive error u_i, of unit variance and correlation phi^gap; a sample observes
    k g_i u_i in white noise of unit variance. Its innovations are white, so that their products need no
    (data, data) matrix.
    """
    n_columns, n_grid = columns.shape[1], phi.size
    product, log_determinant = np.zeros((n_grid, n_columns, n_columns)), np.zeros(n_grid)
    n_wavelengths = len(order.visits[0])
    mean, variance = np.zeros((n_wavelengths, n_columns, n_grid)), np.ones((n_wavelengths, n_grid))
    for visit in order.visits:
        # Prediction: variance = decay^2 variance + (1 - decay^2), as the stationary one is 1. The decay
        # before the first sample of a wavelength is zero: the state starts from its stationary distribution.
        decay = order.correlation_with_previous(visit, phi)
        mean = decay[:, None] * mean[: len(visit)]
        variance = 1.0 - decay**2 * (1.0 - variance[: len(visit)])
        # Innovation, and update.
        gain = relative_signal[visit, None] * np.sqrt(k2)
        innovation = columns[visit, :, None] - gain[:, None] * mean
        innovation_variance = 1.0 + gain**2 * variance
        mean = mean + (variance * gain / innovation_variance)[:, None] * innovation
        variance = variance / innovation_variance
        white = innovation / np.sqrt(innovation_variance)[:, None]
        # Batched matrix products over the grid are faster than einsum here.
        white = white.transpose(2, 0, 1)
        product += white.swapaxes(1, 2) @ white
        log_determinant += np.sum(np.log(innovation_variance), axis=0)
    return product, log_determinant


def _autoregressive_products(columns: np.ndarray, phi: np.ndarray, order: _SampleOrder) -> np.ndarray:
    """Return columns^T R columns (columns, columns, grid), R_ij = phi^|i - j| of the autoregressive error.

    `carried` is the sum over earlier samples, each decayed to the present one.
    """
    n_columns = columns.shape[1]
    carried = np.zeros((len(order.visits[0]), n_columns, phi.size))
    total = np.zeros((n_columns, n_columns, phi.size))
    for visit in order.visits:
        rows = columns[visit]
        carried = order.correlation_with_previous(visit, phi)[:, None] * carried[: len(visit)]
        with_earlier = np.einsum("wi,wjg->ijg", rows, carried)
        total += with_earlier + with_earlier.transpose(1, 0, 2) + (rows.T @ rows)[..., None]
        carried = rows[..., None] + carried
    return total
