"""Statistics over the samples of a sweep: the members along the axis of ``disorder.seed`` alone."""

import warnings
from collections.abc import Iterable

import numpy as np

from vipetsc.io.netcdf import Variables, variable

QUANTILES = 0.05, 0.25, 0.5, 0.75, 0.95


def over_samples(data: Variables, seed: str, names: Iterable[str]) -> Variables:
    """``statistics/<name>/mean``, ``deviation`` and ``quantiles`` of the ``names`` over the dimension ``seed``.

    Of the samples that came out, whose number is ``statistics/samples``. The deviation is divided by n - 1.
    """
    valid = np.isfinite(data["contact_episodes"].values).sum(axis=data["contact_episodes"].dims.index(seed))
    rest = [str(dim) for dim in data["contact_episodes"].dims if dim != seed]
    summary = {
        "quantile": variable("quantile", QUANTILES, "1", "share of the samples that lie below"),
        "statistics/samples": variable(rest, valid, "1", "samples that came out"),
    }
    for name in names:
        item = data[name].transpose(seed, ...)
        values, dims = item.values, tuple(map(str, item.dims[1:]))
        units, text = item.attrs["units"], item.attrs["long_name"]
        with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # NaN where no sample came out
            mean, deviation = np.nanmean(values, axis=0), np.nanstd(values, axis=0, ddof=1)
            quantiles = np.nanquantile(values, QUANTILES, axis=0)
        summary[f"statistics/{name}/mean"] = variable(dims, mean, units, f"{text}: mean over the samples")
        summary[f"statistics/{name}/deviation"] = variable(dims, deviation, units, f"{text}: standard deviation")
        summary[f"statistics/{name}/quantiles"] = variable(("quantile", *dims), quantiles, units, f"{text}: quantiles")
    return summary
