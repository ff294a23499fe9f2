"""PROSPECT: leaf reflectance and transmittance from 400 to 2500 nm, from leaf structure and chemistry.

A leaf is a pile of N absorbing plates (Jacquemoud and Baret 1990, RSE 34, 75). One plate has the optical
depth

    k(wavelength) = sum over traits i of c_i K_i(wavelength) / N,

with the contents c_i per leaf area and the specific absorption coefficients K_i. The plate model
(`jaxlidar.optics.plate_model`) turns k, N and the refractive index n(wavelength) into reflectance and
transmittance,

    R, T = plate_model(k, N, leaf_surface(n, alpha)).

K_i and n are interpolated linearly between the table's wavelengths; where one of these is traced, derivatives
are the means of those on both sides. All traits but N act through k alone, so that derivatives are a chain:
dR/dc_i = (dR/dk) K_i/N, and in N at constant c_i, (dR/dN at constant k) - (dR/dk) k/N.

The versions differ in their coefficients and in their traits (RSE: Remote Sens. Environ.):

| version | traits besides N | calibration |
| --- | --- | --- |
| "4" | Cab, Cw, Cm | Feret et al. (2008), RSE 112, 3030 |
| "5" | Cab, Car, Cbrown, Cw, Cm | the same |
| "D" | Cab, Car, Cant, Cbrown, Cw, Cm | Feret et al. (2017), RSE 193, 204 |
| "PC" | Cab, Car, Cant, Cbrown, Cw, Cp, Cc | Jacquemoud et al. (1996), RSE 56, 194; pigments, water: "D" |
| "PRO" | Cab, Car, Cant, Cbrown, Cw, Cp, Cc | Feret et al. (2021), RSE 252, 112173 |

"PC" and "PRO" split dry matter into protein (Cp) and the rest (Cc): cellulose and lignin in "PC",
carbon-based constituents in "PRO". Numerical limits: see `jaxlidar.plate_model`.
"""

import functools
from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._fields.checks import (
    Magnitude,
    as_numpy,
    as_scalar,
    check_choice,
    check_integer,
    check_kind,
    check_number,
    check_numbers,
    check_range,
    concrete,
)
from jaxlidar._fields.ranges import NOT_NEGATIVE, Range, check_ranges, quantity
from jaxlidar._jax.one_function import barrier
from jaxlidar._jax.products import tensordot
from jaxlidar.optics.coefficients import TRAITS, Coefficients, shipped
from jaxlidar.optics.leaf_surface import LeafSurface, leaf_surface
from jaxlidar.optics.plate_model import plate_model, plate_model_slopes
from jaxlidar.optics.spectra import interpolate

# Leaves hold 0 to 150 ug/cm2 of a pigment, 0.001 to 0.1 cm of water, 0.001 to 0.05 g/cm2 of dry matter.
_PIGMENT = Magnitude("ug/cm2", 0.0, 300.0, {"mg/m2": 0.1, "ug/m2": 1e-4})
_WATER = Magnitude("cm", 0.0, 1.0, {"um": 1e-4, "g/m2": 1e-4})
_DRY_MATTER = Magnitude("g/cm2", 0.0, 1.0, {"g/m2": 1e-4, "ug/cm2": 1e-6})
_DEFAULTS = {
    "Cab": 40.0,
    "Car": 8.0,
    "Cant": 0.0,
    "Cbrown": 0.0,
    "Cw": 0.01,
    "Cm": 0.009,
    "Cp": 0.001,
    "Cc": 0.009,
}

_Spectra = Float[Array, "*leaves_and_wavelengths"]
# Leaves whose spectra are computed at once: their arrays fit into the processor's cache. One batch of 10,000
# takes longer than 100 batches of 100.
_LEAVES_AT_ONCE = 100


@final
class Prospect(eqx.Module):
    """A leaf by the PROSPECT model: `R, T = leaf(wavelengths)` are its reflectance and transmittance.

    Every output is differentiable in every trait, and traits may be traced. For many leaves map over the
    construction, e.g. `jax.vmap(lambda N, Cab: Prospect(N=N, Cab=Cab))(N, Cab)`.
    Called, it gives the spectra of them all.

    **Arguments:** all traits are single numbers. A trait of None has the value given below where the version
    has this trait, and is 0 otherwise.

    - `N`: number of elementary plates, real, 1 or more. Default 1.5.
    - `Cab`: chlorophyll a + b, ug/cm2, not negative. Default None: 40.
    - `Car`: carotenoids, ug/cm2, not negative. Default None: 8.
    - `Cant`: anthocyanins, ug/cm2, not negative. Default None: 0.
    - `Cbrown`: brown pigments, arbitrary units, not negative. Default None: 0.
    - `Cw`: equivalent water thickness, cm, not negative. Default None: 0.01.
    - `Cm`: dry matter, g/cm2, not negative. Default None: 0.009.
    - `Cp`: protein, g/cm2, not negative. Default None: 0.001.
    - `Cc`: cellulose and lignin ("PC") or carbon-based constituents ("PRO"), g/cm2, not negative. Default
      None: 0.009.
    - `version`: "4", "5", "D", "PC" or "PRO"; their traits are listed in `jaxlidar.optics.prospect`. Default
      "D".
    - `alpha`: half-angle of the cone of incidence, degrees, in [0, 90]. Fixed: not differentiable. Default
      40.
    - `coefficients`: for version "PRO", and only for it, the table from `load_coefficients`. Default None.

    **Raises:** ValueError, naming field, value and admissible range: for a trait that is negative, not finite
    or not a single number, for a trait other than 0 that the version does not have (hence `Cm` with "PC" and
    "PRO"), for N below 1, alpha outside [0, 90], an unknown version, and `coefficients` that are missing or
    not admissible. TypeError for arguments that are no numbers. Traced values are not checked. A content so
    large that another unit is likely, such as a `Cw` in micrometres, gives a `UnitWarning`.

    **Source:** Jacquemoud and Baret (1990), Remote Sens. Environ. 34, 75, and those of the versions.

    **Example:**

    >>> import jaxlidar as jl
    >>> leaf = jl.Prospect(N=1.5, Cab=30.0, Cw=0.012)
    >>> R, T = leaf([532.0, 1064.0])
    >>> print([f"{x:.2f}" for x in R], [f"{x:.2f}" for x in T])
    ['0.16', '0.44'] ['0.16', '0.48']
    """

    N: Float[Array, ""] = quantity(range=Range(1.0))
    Cab: Float[Array, ""] = quantity(unit=_PIGMENT, range=NOT_NEGATIVE)
    Car: Float[Array, ""] = quantity(unit=_PIGMENT, range=NOT_NEGATIVE)
    Cant: Float[Array, ""] = quantity(unit=_PIGMENT, range=NOT_NEGATIVE)
    Cbrown: Float[Array, ""] = quantity(range=NOT_NEGATIVE)
    Cw: Float[Array, ""] = quantity(unit=_WATER, range=NOT_NEGATIVE)
    Cm: Float[Array, ""] = quantity(unit=_DRY_MATTER, range=NOT_NEGATIVE)
    Cp: Float[Array, ""] = quantity(unit=_DRY_MATTER, range=NOT_NEGATIVE)
    Cc: Float[Array, ""] = quantity(unit=_DRY_MATTER, range=NOT_NEGATIVE)
    version: str = eqx.field(static=True)
    alpha: float = eqx.field(static=True)
    coefficients: Coefficients | None = eqx.field(static=True)

    def __init__(
        self,
        N: ArrayLike = 1.5,
        Cab: ArrayLike | None = None,
        Car: ArrayLike | None = None,
        Cant: ArrayLike | None = None,
        Cbrown: ArrayLike | None = None,
        Cw: ArrayLike | None = None,
        Cm: ArrayLike | None = None,
        *,
        Cp: ArrayLike | None = None,
        Cc: ArrayLike | None = None,
        version: str = "D",
        alpha: float | int = 40.0,
        coefficients: Coefficients | None = None,
    ):
        check_choice("version", version, tuple(TRAITS))
        if (version == "PRO") != (coefficients is not None):
            raise ValueError(
                f"coefficients = {coefficients!r} with version {version!r}: version 'PRO' needs a table from "
                "load_coefficients, and the other versions admit None only"
            )
        if coefficients is not None:
            check_kind("coefficients", coefficients, Coefficients, "a table from load_coefficients")
        check_number("alpha", alpha, 0.0, 90.0)
        pigments = {"Cab": Cab, "Car": Car, "Cant": Cant, "Cbrown": Cbrown}
        contents = {**pigments, "Cw": Cw, "Cm": Cm, "Cp": Cp, "Cc": Cc}
        self.N = _trait("N", N)
        for name, value in contents.items():
            is_in_version = name in TRAITS[version]
            if value is None:
                value = _DEFAULTS[name] if is_in_version else 0.0
            elif not is_in_version and not _is_zero(value):
                raise ValueError(
                    f"{name} = {value} is no trait of version {version!r} ({', '.join(TRAITS[version])}): "
                    "only 0 is admissible"
                )
            setattr(self, name, _trait(name, value))
        self.version, self.alpha, self.coefficients = version, float(alpha), coefficients
        check_ranges(self)

    @classmethod
    def paper(cls) -> "Prospect":
        """The leaf that reproduces Table 4 of the published lidar simulator.

        At 532, 1064 and 1550 nm that table gives reflectances of 36, 66 and 57 % and transmittances of 8, 30
        and 27 %, computed by PROSPECT 2.01, whose coefficients are not public in full. This leaf is
        PROSPECT-D with N = 3.4, Cab = 20 ug/cm2 and Cw = 0.002 cm from the paper's Table 3. Car = 6.07 ug/cm2
        and Cm = 0.00463 g/cm2, which stand for what version 2.01 folded into its columns, were fitted to
        Table 4; they match it within 0.25 percentage points (rms).

        **Returns:** a `Prospect`.
        """
        return cls(N=3.4, Cab=20.0, Car=6.07, Cant=0.0, Cbrown=0.0, Cw=0.002, Cm=0.00463)

    def __call__(self, wavelengths: ArrayLike | Sequence[ArrayLike]) -> tuple[_Spectra, _Spectra]:
        """Hemispherical reflectance and transmittance for light within the cone of incidence `alpha`.

        **Arguments:**

        - `wavelengths`: nm, any shape, within the table (400 to 2500 for those shipped). Traced wavelengths
          are admitted but cannot be checked: outside the table they give NaN. The surface is then computed in
          working precision.

        **Returns:** reflectance and transmittance, shaped as `wavelengths`; (leaves, wavelengths) of many
        leaves, whose traits have a leading axis, as `jax.vmap` over their construction makes them. These are
        computed in batches; call them under `jax.jit`.

        **Raises:** ValueError where a wavelength lies outside the table or is not a number.

        **Example:** leaves of two thicknesses.

        >>> import jaxlidar as jl
        >>> import jax
        >>> leaves = jax.vmap(lambda N: jl.Prospect(N=N))(jax.numpy.array([1.2, 2.0]))
        >>> R, T = leaves([1064.0])
        >>> print([f"{x:.2f}" for x in R[:, 0]], [f"{x:.2f}" for x in T[:, 0]])
        ['0.38', '0.51'] ['0.53', '0.40']
        """
        return self._optics(wavelengths)[:2]

    def absorptance(self, wavelengths: ArrayLike | Sequence[ArrayLike]) -> _Spectra:
        """Absorptance, 1 - R - T, accurate also for nearly transparent leaves.

        It is computed without subtraction.

        **Arguments:**

        - `wavelengths`: nm, as for calling the leaf.

        **Returns:** an array shaped as `wavelengths`.

        **Raises:** ValueError where a wavelength lies outside the table or is not a number.
        """
        return self._optics(wavelengths)[2]

    def jacobian(
        self, wavelengths: ArrayLike | Sequence[ArrayLike], batch_size: int = 20
    ) -> tuple[tuple[_Spectra, _Spectra], dict[str, tuple[_Spectra, _Spectra]]]:
        """Spectra of many leaves with their derivatives in every trait, at less than three times the cost.

        All traits but N act through k alone, so the plate model is differentiated only twice, in k and in N.

        **Arguments:**

        - `wavelengths`: nm, as for calling the leaf.
        - `batch_size`: leaves evaluated at once, an integer, at least 1. Default 20.

        **Returns:** first the reflectance and transmittance, (leaves, wavelengths) each. Then a dict, by name
        ("N" and the traits of the version), of the derivatives of these two, of the same shape, per unit of
        the trait.

        **Raises:** ValueError as for calling the leaf, for traits without an axis of leaves, and where
        `batch_size` is no integer of at least 1.

        **Example:** how reflectance at 550 nm falls with chlorophyll, per ug/cm2.

        >>> import jaxlidar as jl
        >>> import jax
        >>> leaves = jax.vmap(lambda Cab: jl.Prospect(Cab=Cab))(jax.numpy.array([20.0, 60.0]))
        >>> (R, T), slopes = leaves.jacobian([550.0])
        >>> print([f"{x:.4f}" for x in slopes["Cab"][0][:, 0]])
        ['-0.0053', '-0.0015']
        """
        if self.N.ndim == 0:
            raise ValueError("N has shape (); admissible are traits of shape (leaves,), as jax.vmap makes")
        batch_size = check_integer("batch_size", batch_size)
        return jax.lax.map(lambda leaf: leaf._slopes(wavelengths), self, batch_size=batch_size)

    def _slopes(self, wavelengths: Any) -> tuple[tuple[Array, Array], dict[str, tuple[Array, Array]]]:
        """Spectra of one leaf, and their derivatives by the name of the trait."""
        absorption, face = material(self, wavelengths)
        k = self._k(absorption)
        (R, T, _), (R_k, T_k, _), (R_N, T_N, _) = plate_model_slopes(k, self.N, face)
        # Without this optimisation barrier the compiler would compute them again for every trait.
        R, T, R_k, T_k, R_N, T_N = barrier((R, T, R_k, T_k, R_N, T_N))
        # At constant contents dk/dN = -k/N.
        k_over_N = k / self.N
        slopes = {"N": (R_N - R_k * k_over_N, T_N - T_k * k_over_N)}
        R_k, T_k = R_k / self.N, T_k / self.N
        for name, column in zip(TRAITS[self.version], absorption):
            slopes[name] = (R_k * column, T_k * column)
        return (R, T), slopes

    def _optics(self, wavelengths: Any) -> tuple[Array, Array, Array]:
        if self.N.ndim:
            return jax.lax.map(lambda leaf: leaf._optics(wavelengths), self, batch_size=_LEAVES_AT_ONCE)
        absorption, face = material(self, wavelengths)
        return plate_model(self._k(absorption), self.N, face)

    def _k(self, absorption: Array) -> Array:
        """Optical depth of one plate, from the specific absorption coefficients (traits, wavelengths)."""
        return _optical_depth([getattr(self, name) for name in TRAITS[self.version]], absorption, self.N)


@jax.jit
def _optical_depth(contents: list[Array], absorption: Array, N: Array) -> Array:
    # The highest precision: some accelerators multiply matrices of single precision with fewer digits.
    return tensordot(jnp.stack(contents), absorption, 1) / N


def _trait(name: str, value: ArrayLike) -> Float[Array, ""]:
    """Convert a trait to a scalar array. **Raises:** as `Prospect`."""
    check_numbers(name, value)
    if np.size(value) != 1:
        raise ValueError(
            f"{name} has shape {np.shape(value)}; a leaf's traits are scalars; jax.vmap makes many leaves"
        )
    return as_scalar(value, name)


def _is_zero(value: ArrayLike) -> bool:
    number = concrete(value)
    return number is not None and bool(np.all(number == 0))


def material(leaf: Prospect, wavelengths: Any) -> tuple[Array, LeafSurface]:
    """Specific absorption coefficients (traits, wavelengths) and the leaf's surface, at the wavelengths.

    Both depend on nothing that is fitted: for wavelengths that are not traced they are constants of the
    compiled program.
    """
    table = shipped(leaf.version) if leaf.coefficients is None else leaf.coefficients
    dtype = leaf.N.dtype
    if isinstance(wavelengths, Tracer):
        grid = jnp.asarray(table.wavelength, dtype)
        x = wavelengths.astype(dtype)
        columns = [
            interpolate(x, grid, jnp.asarray(c, dtype), outside=jnp.nan)
            for c in (table.index, *table.absorption)
        ]
        return jnp.stack(columns[1:]), leaf_surface(columns[0], leaf.alpha)
    x = as_numpy(wavelengths, "wavelengths")
    check_range("wavelengths", x, table.wavelength[0], table.wavelength[-1])
    absorption, face = _tabulated(table, x.tobytes(), x.shape, leaf.alpha)
    return jax.device_put(absorption.astype(dtype)), face


@functools.lru_cache(maxsize=64)
def _tabulated(
    table: Coefficients, wavelengths: bytes, shape: tuple[int, ...], alpha: float
) -> tuple[np.ndarray, LeafSurface]:
    """`material` at wavelengths given by the bytes of an array of float64, which a cache can look up."""
    x = np.frombuffer(wavelengths).reshape(shape)
    absorption = np.stack([np.interp(x, table.wavelength, c) for c in table.absorption])
    return absorption, leaf_surface(np.interp(x, table.wavelength, table.index), alpha)
