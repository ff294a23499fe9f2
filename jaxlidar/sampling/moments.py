"""Running moments: mean and squared deviations of batches, in one pass.

Let v_1 ... v_n be the results of n independent batches, and d = v_n - m_{n-1} the deviation of the newest one
from the mean before it. The mean m and the sum of squared deviations S follow (Welford 1962, Technometrics 4,
419)

    m_n = m_{n-1} + d / n
    S_n = S_{n-1} + e_n^2,    e_n = d sqrt((n - 1) / n)

All terms of S are squares, so that it is never negative, whatever is rounded. Moments of a and of b batches
merge to (Chan, Golub and LeVeque 1983, Am. Stat. 37, 242)

    m = m_a + b / (a + b) (m_b - m_a)
    S = S_a + S_b + a b / (a + b) (m_b - m_a)^2

The standard error of the mean is sqrt(S / (n (n - 1))), widened by Student's t (`jaxlidar.sampling.errors`).

Values are trees of arrays, of NumPy on the host and of JAX within compiled programs: the code is the same,
for `x += y` changes an array of NumPy in place and makes a new one of JAX.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlidar.sampling.errors import floating, namespace_of, student_widening


class RunningMoments(NamedTuple):
    """Mean and squared deviations of batches.

    - `count`: number of batches; an int on the host, an int32 scalar in compiled programs.
    - `mean`: tree of arrays, the mean of the quantities whose standard errors are needed.
    - `squares`: the same tree, their sums of squared deviations.
    - `mean_only`: tree of arrays, the mean of quantities without standard errors. Squared deviations of
      responses would double the memory and the time that they take.
    """

    count: Any
    mean: Any
    squares: Any
    mean_only: Any = ()

    @staticmethod
    def on_host(like: Any, mean_only_like: Any = ()) -> "RunningMoments":
        """Return moments of no batch, as NumPy arrays of double precision with the shapes of `like`."""

        def zeros(tree: Any) -> Any:
            return jax.tree.map(lambda a: np.zeros(a.shape), tree)

        return RunningMoments(0, zeros(like), zeros(like), zeros(mean_only_like))

    @staticmethod
    def in_program(like: Any, mean_only_like: Any = ()) -> "RunningMoments":
        """Return moments of no batch within a compiled program, with the shapes and types of `like`."""

        def zeros(tree: Any) -> Any:
            return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), tree)

        return RunningMoments(jnp.zeros((), jnp.int32), zeros(like), zeros(like), zeros(mean_only_like))

    @staticmethod
    def of_batches(values: Any, mean_only: Any = ()) -> "RunningMoments":
        """Return the moments of batches that lie along axis 0 of arrays, within a compiled program."""

        def mean_of(tree: Any) -> Any:
            return jax.tree.map(lambda a: jnp.mean(a, axis=0), tree)

        mean = mean_of(values)
        squares = jax.tree.map(lambda a, m: jnp.sum((a - m[None]) ** 2, axis=0), values, mean)
        count = jnp.asarray(jax.tree.leaves(values)[0].shape[0], jnp.int32)
        return RunningMoments(count, mean, squares, mean_of(mean_only))

    def update(self, value: Any, mean_only: Any = ()) -> "RunningMoments":
        """Return the moments with one more batch. On the host, those before it are overwritten."""
        count = self.count + 1
        # On the host, arrays of JAX become those of NumPy: otherwise sums would lose their double precision.
        value, mean_only = (
            jax.tree.map(np.asarray, tree) if isinstance(self.count, int) else tree
            for tree in (value, mean_only)
        )
        values, structure = jax.tree.flatten(value)
        means, squares = structure.flatten_up_to(self.mean), structure.flatten_up_to(self.squares)
        updated = [_update(m, s, v, count) for m, s, v in zip(means, squares, values)]
        return RunningMoments(
            count,
            structure.unflatten([m for m, _ in updated]),
            structure.unflatten([s for _, s in updated]),
            jax.tree.map(lambda m, v: _update_mean(m, v, count), self.mean_only, mean_only),
        )

    def merge(self, second: "RunningMoments") -> "RunningMoments":
        """Return the moments of the batches of both."""
        count = self.count + second.count
        first_count, second_count = floating(self.count), floating(second.count)
        fraction = second_count * (1.0 / floating(count))

        def mean(mean_a: Any, mean_b: Any) -> Any:
            return mean_a + fraction * (mean_b - mean_a)

        def squares(s_a: Any, s_b: Any, mean_a: Any, mean_b: Any) -> Any:
            return s_a + s_b + first_count * fraction * (mean_b - mean_a) ** 2

        return RunningMoments(
            count,
            jax.tree.map(mean, self.mean, second.mean),
            jax.tree.map(squares, self.squares, second.squares, self.mean, second.mean),
            jax.tree.map(mean, self.mean_only, second.mean_only),
        )

    @property
    def stderr(self) -> Any:
        """Standard errors of `mean`, widened for few batches; of two batches or more."""
        count = floating(self.count)
        scale = student_widening(count) / (count * (count - 1.0)) ** 0.5
        return jax.tree.map(lambda s: scale * namespace_of(s).sqrt(s), self.squares)


def scaled_deviation(value: Any, mean: Any, count: Any) -> Any:
    """Return e_n, whose square is what batch number `count` adds to the squared deviations.

    `mean`: that of the batches before it. It is linear in the batches: the squared deviations of any linear
    map of them are the sums of squares of its values of e_n.
    """
    # Not (count - 1) / count: JAX divides integers of 32 bits in single precision, also where all else is
    # double.
    return (value - mean) * (1.0 - 1.0 / floating(count)) ** 0.5


def _update_mean(mean: Any, value: Any, count: Any) -> Any:
    mean += (value - mean) / floating(count)
    return mean


def _update(mean: Any, squares: Any, value: Any, count: Any) -> tuple[Any, Any]:
    """Return the mean and the squared deviations of one array with one more value."""
    # In place: for spectra at thousands of wavelengths, new arrays take longer than the sums.
    scaled = scaled_deviation(value, mean, count)
    scaled *= scaled
    squares += scaled
    return _update_mean(mean, value, count), squares
