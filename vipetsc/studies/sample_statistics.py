"""Statistics over the samples of a sweep, which are its members along the axis of ``disorder.seed``."""

import warnings
from collections.abc import Iterable

import numpy as np
import xarray as xr

from vipetsc.io.netcdf import Variables, variable

# The median, the quartiles, and at both ends those between which nine of ten samples lie: figures shade this band.
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def over_samples(data: Variables, seed: str, names: Iterable[str]) -> Variables:
    """Return mean, deviation and ``QUANTILES`` of the variables ``names`` in ``data`` over the dimension ``seed``.

    They are called ``statistics/<name>/mean``, ``deviation`` and ``quantiles``, and are of the samples that have a
    value, whose number is ``statistics/<name>/samples``; ``statistics/samples`` is the number of those that did not
    fail. The variance of n samples is divided by n - 1.
    """
    # A failed member has NaN in every measure; the number of contact episodes is one that all others have.
    episodes = data["contact_episodes"]
    valid = np.isfinite(episodes.values).sum(axis=episodes.dims.index(seed))
    other_dims = [str(dim) for dim in episodes.dims if dim != seed]
    summary = {
        "quantile": variable("quantile", QUANTILES, "1", "fraction of the samples below the quantile"),
        "statistics/samples": variable(other_dims, valid, "1", "number of successful samples"),
    }
    for name in names:
        summary |= _statistics(f"statistics/{name}", data[name].transpose(seed, ...))
    return summary


def _statistics(prefix: str, item: xr.Variable) -> Variables:
    """Return mean, deviation and quantiles of an ``item`` over its first dimension, called ``prefix``/..."""
    dims = tuple(map(str, item.dims[1:]))
    units = item.attrs["units"]
    text = item.attrs["long_name"]
    # NumPy warns where all samples have failed, or one is left, of which there is no deviation: NaN says so.
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        mean = np.nanmean(item.values, axis=0)
        deviation = np.nanstd(item.values, axis=0, ddof=1)
        quantiles = np.nanquantile(item.values, QUANTILES, axis=0)
    count = np.isfinite(item.values).sum(axis=0)
    return {
        f"{prefix}/samples": variable(dims, count, "1", f"{text}: number of samples with a value"),
        f"{prefix}/mean": variable(dims, mean, units, f"{text}: mean over the samples"),
        f"{prefix}/deviation": variable(dims, deviation, units, f"{text}: standard deviation"),
        f"{prefix}/quantiles": variable(("quantile", *dims), quantiles, units, f"{text}: quantiles"),
    }
