"""Retrievals as netCDF files: what `jaxlidar.io.save` and `jaxlidar.open` must know of them."""

from inversion.fit.result import Retrieval, Retrievals
from jaxlidar.io import keep_as_netcdf

_OWN = "units of the unknown"
_QUANTITIES = {
    "values": (_OWN, "best value of an unknown"),
    "stderr": (_OWN, "standard error of an unknown"),
    "robust_stderr": (_OWN, "standard error of an unknown, widened by misfit and the spread over starts"),
    "prior_share": ("1", "share of the information on an unknown that is the prior's"),
    "at_bound": ("1", "whether an unknown lies at one of its bounds"),
    "covariance": (_OWN, "covariance of the unknowns, in the order of labels"),
    "reduced_chi2": ("1", "sum of squared residuals over the degrees of freedom"),
    "second_minimum": ("1", "rise in chi-squared to a second minimum, in units of independent samples"),
    "averaging": (
        "ratio of the units of the unknowns",
        "derivatives of the estimates in the truth, in the order of labels",
    ),
    "strength": (_OWN, "strength of a smoothness prior, in the unit of the unknown"),
    "bounds": (_OWN, "lower and upper bounds of an unknown"),
    "independent_samples": ("1", "independent samples that tell as much as the correlated ones fitted"),
}

keep_as_netcdf(
    Retrieval,
    "scene properties retrieved from a lidar waveform",
    {
        **_QUANTITIES,
        "simulation_error": (_OWN, "part of the standard error that the simulation's noise makes"),
        "correlation": ("1", "correlation of the unknowns, in the order of labels"),
        "residuals": ("1", "observed minus fitted over its standard deviation"),
    },
    dimensions={"n": "labels", "bins": "time", "wavelengths": "wavelength"},
)
keep_as_netcdf(
    Retrievals,
    "scene properties retrieved from many lidar waveforms",
    {
        **_QUANTITIES,
        "converged": ("1", "whether the fit ended at a minimum"),
        "steps": ("1", "waveforms simulated, each with its Jacobian"),
        "fitted": ("1", "fitted apparent reflectance per sample, without the scale"),
    },
    dimensions={"n": "labels", "footprints": "footprint", "bins": "time", "wavelengths": "wavelength"},
)
