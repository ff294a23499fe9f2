r"""Standard errors widened by misfit: a model that is wrong leaves residuals that are large where the signal
is, and alike from sample to sample.

The residuals of a fit, in standard deviations of the stated noise, are taken as a draw from

    C_ij = a^2 (delta_ij + k^2 g_i g_j phi^|i - j|),    g_i = s_i / max s,

with s the simulated signal in the same units: noise of amplitude a, and an error of the model that is k times
as large at the signal's peak, in proportion to the signal, correlated over neighbouring samples, and
independent between wavelengths. Each phi and k of a grid counts by the likelihood of the residuals where the
unknowns are integrated out (restricted likelihood), so that the degrees of freedom that the unknowns took are
made up for. With C the mean over the grid, J the whitened Jacobian and P the prior precision, the covariance
of the fitted values is the sandwich

    H^-1 (J^T C J + P) H^-1,    H = J^T J + P.

Short records leave phi and k open, and the mean over the grid is then on the safe side: with noise alone,
robust errors are up to twice the plain ones. They tell what misfit tells: an error of the model that the
unknowns absorb without a trace, such as a clock that is off, stays hidden.

**Source:** restricted likelihood: Patterson and Thompson (1971), Biometrika 58, 545; sandwich: White (1980),
Econometrica 48, 817.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

# Grids of phi and k^2.
_CORRELATIONS = (0.0, 0.5, 0.8, 0.92, 0.97)
_EXCESSES = (0.0, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
# So many degrees of freedom tell something about residuals.
_FEWEST = 8.0
# Of the unknowns' information, added to it.
_ROUNDING = 1e-12


class Misfit(NamedTuple):
    """What residuals say.

    - `middle`: J^T C J, the middle of the sandwich.
    - `samples`: how many independent samples tell as much as the correlated ones, (tr C)^2 / tr C^2.
    """

    middle: Float[np.ndarray, "n n"]
    samples: float


def misfit_of(
    residual: Float[np.ndarray, " data"],
    jacobian: Float[np.ndarray, "data n"],
    precision: Float[np.ndarray, "n n"],
    determined: float,
    signal: Float[np.ndarray, " data"],
    place: tuple[Int[np.ndarray, " data"], Int[np.ndarray, " data"]],
) -> Misfit:
    """What the residuals of a fit say.

    **Arguments:**

    - `residual`, `jacobian`: whitened by the stated noise.
    - `precision`: matrix of the priors, 0 where there is none.
    - `determined`: number of unknowns that the data determine.
    - `signal`: simulated, in standard deviations of the stated noise.
    - `place`: number of the wavelength, and of the sample.

    **Returns:** a `Misfit`; that of the stated noise where too few samples tell.
    """
    freedom = residual.size - determined
    if freedom < _FEWEST or not np.any(residual):
        return Misfit(jacobian.T @ jacobian, float(residual.size))
    both = np.column_stack([jacobian, residual])
    size = np.linalg.norm(both, axis=0)
    size = np.where(size > 1e-100, size, 1.0)
    both = both / size
    # The prior's information; collinear unknowns are kept apart.
    prior = np.pad(precision, (0, 1)) / np.outer(size, size) + _ROUNDING * np.eye(size.size)
    share = np.abs(signal) / max(np.max(np.abs(signal)), 1e-300)
    # Every phi with every k^2.
    phi, excess = (a.ravel() for a in np.meshgrid(_CORRELATIONS, _EXCESSES, indexing="ij"))
    chain = _chain(place)
    product, logdet = _whitened(both, share, excess, phi, chain)
    root = np.linalg.cholesky(product + prior)
    # Of the root, the last is the residual less what the unknowns take of it.
    diagonal = np.diagonal(root, axis1=1, axis2=2)
    square = (diagonal[:, -1] * size[-1]) ** 2 / freedom
    likelihood = logdet + freedom * np.log(square) + 2.0 * np.sum(np.log(diagonal[:, :-1]), axis=1)
    weight = np.exp(-0.5 * (likelihood - likelihood.min()))
    weight /= np.sum(weight)
    weak = _with_neighbours(share[:, None] * both[:, :-1], phi, chain)
    plain = both[:, :-1].T @ both[:, :-1]
    middle = np.sum(weight * square) * plain + np.einsum("cdg,g->cd", weak, weight * square * excess)
    power = (share**2)[:, None]
    trace = residual.size + excess * np.sum(power)
    squares = residual.size + 2.0 * excess * np.sum(power)
    squares = squares + excess**2 * _with_neighbours(power, phi**2, chain)[0, 0]
    return Misfit(middle * np.outer(size[:-1], size[:-1]), float(weight @ (trace**2 / squares)))


class _Chain(NamedTuple):
    """The order in which samples are correlated. Wavelengths are independent, and gone through together.

    - `turns`: indices of the first sample of each wavelength, of the second, and so on.
    - `steps`: of each sample, bins from the one before; 0 where a wavelength begins.
    """

    turns: list[Int[np.ndarray, " wavelengths"]]
    steps: Int[np.ndarray, " data"]

    def decay(self, turn: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """(wavelengths, grid) correlation of samples with those before."""
        steps = self.steps[turn, None]
        return np.where(steps > 0, phi**steps, 0.0)


def _chain(place: tuple[np.ndarray, np.ndarray]) -> _Chain:
    wavelength, sample = place
    _, first, count = np.unique(wavelength, return_index=True, return_counts=True)
    # Wavelengths with most samples come first, so that those that go on are the first ones.
    order = np.argsort(-count, kind="stable")
    first, count = first[order], count[order]
    turns = [first[: np.searchsorted(-count, -turn)] + turn for turn in range(count[0])]
    steps = np.append(0, np.where(np.diff(wavelength) == 0, np.diff(sample), 0))
    return _Chain(turns, steps)


def _whitened(
    columns: np.ndarray, share: np.ndarray, excess: np.ndarray, phi: np.ndarray, chain: _Chain
) -> tuple[np.ndarray, np.ndarray]:
    """(grid, columns, columns) columns^T C^-1 columns, with a = 1, and ln det C: by a Kalman filter."""
    wide, many = columns.shape[1], phi.size
    product, logdet = np.zeros((many, wide, wide)), np.zeros(many)
    mean, variance = np.zeros((len(chain.turns[0]), wide, many)), np.ones((len(chain.turns[0]), many))
    for turn in chain.turns:
        decay, own = chain.decay(turn, phi), share[turn, None] * np.sqrt(excess)
        mean, variance = decay[:, None] * mean[: len(turn)], 1.0 - decay**2 * (1.0 - variance[: len(turn)])
        innovation, spread = columns[turn, :, None] - own[:, None] * mean, 1.0 + own**2 * variance
        mean = mean + (variance * own / spread)[:, None] * innovation
        variance = variance / spread
        white = innovation / np.sqrt(spread)[:, None]
        # As products of matrices, one for each of the grid.
        white = white.transpose(2, 0, 1)
        product += white.swapaxes(1, 2) @ white
        logdet += np.sum(np.log(spread), axis=0)
    return product, logdet


def _with_neighbours(columns: np.ndarray, phi: np.ndarray, chain: _Chain) -> np.ndarray:
    """(columns, columns, grid) columns^T R columns, with R the correlation."""
    carried = np.zeros((len(chain.turns[0]), columns.shape[1], phi.size))
    total = np.zeros((columns.shape[1], columns.shape[1], phi.size))
    for turn in chain.turns:
        rows = columns[turn]
        carried = chain.decay(turn, phi)[:, None] * carried[: len(turn)]
        before = np.einsum("wi,wjg->ijg", rows, carried)
        total += before + before.transpose(1, 0, 2) + (rows.T @ rows)[..., None]
        carried = rows[..., None] + carried
    return total
