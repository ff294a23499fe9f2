"""Registration of results of retrievals with `jaxlidar.io.save` and `jaxlidar.open`.

The group of entry points "jaxlidar.files" in pyproject.toml names this module for each class, so that
`jaxlidar.open` finds it by the name of the class in a file.
"""

from inversion.fit.result import Retrieval
from inversion.scene.scene_retrieval import SceneRetrieval
from jaxlidar.io import keep_as_netcdf

# The unit of an unknown is that of the scene's array, or of `apply`: it cannot be known here.
_UNIT_OF_UNKNOWN = "units of the unknown"
_QUANTITIES = {
    "values": (_UNIT_OF_UNKNOWN, "best value of an unknown"),
    "stderr": (_UNIT_OF_UNKNOWN, "standard error of an unknown"),
    "robust_stderr": (
        _UNIT_OF_UNKNOWN,
        "standard error of an unknown, widened by misfit and the spread over starts",
    ),
    "prior_share": ("1", "share of the prior in an estimate: one less the diagonal of the averaging kernel"),
    "at_bound": ("1", "1 for an unknown at one of its bounds"),
    "covariance": (_UNIT_OF_UNKNOWN, "covariance of the unknowns, in the order of labels"),
    "reduced_chi2": ("1", "sum of squared residuals over the degrees of freedom"),
    "second_minimum": ("1", "rise in chi-squared to a second minimum, for independent samples"),
    "averaging": (
        "ratio of the units of the unknowns",
        "derivatives of the estimates in the truth, in the order of labels",
    ),
    "strength": (_UNIT_OF_UNKNOWN, "strength of a smoothness prior, in the unit of the unknown"),
    "bounds": (_UNIT_OF_UNKNOWN, "lower and upper bounds of an unknown"),
    "independent_samples": ("1", "effective number of independent samples among those fitted"),
}

keep_as_netcdf(
    Retrieval,
    "scene properties retrieved from lidar waveforms",
    {
        **_QUANTITIES,
        "simulation_error": (_UNIT_OF_UNKNOWN, "part of the standard error from the simulation's noise"),
        "residuals": ("1", "observed minus fitted, whitened by the covariance of the noise"),
        "converged": ("1", "1 for a fit that ended at a minimum"),
        "steps": ("1", "waveforms simulated, each with its Jacobian"),
        "fitted": ("1", "fitted apparent reflectance per sample, before the recorder"),
    },
    dimensions={"n": "labels", "footprints": "footprint", "bins": "time", "wavelengths": "wavelength"},
    rows="footprints",
)
keep_as_netcdf(
    SceneRetrieval,
    "a scene retrieved from many lidar waveforms",
    {
        **{name: _QUANTITIES[name] for name in ("values", "stderr", "at_bound", "averaging", "bounds")},
        "draws": (_UNIT_OF_UNKNOWN, "draws of the error of an unknown"),
        "places": ("1", "indices of the values whose averaging kernels are in averaging"),
        "time": ("ns", "time of the samples"),
        "wavelength": ("nm", "wavelength"),
        "fitted": ("units of the records", "fitted records, with gain and offset"),
        "residuals": ("1", "observed minus fitted, over the noise"),
        "held_out": ("1", "1 for shots that were not fitted"),
        "misfit": ("1", "chi-squared of the fitted shots over their number of samples"),
        "held_out_misfit": ("1", "chi-squared of the shots held out over their number of samples"),
        "history": ("1", "misfit, held-out misfit and objective after each step"),
    },
    dimensions={"samples": "time", "wavelengths": "wavelength", "shots": "shot", "3": "quantity"},
)
