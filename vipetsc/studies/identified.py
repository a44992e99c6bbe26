"""Content of ``identified.h5``: parameters with their uncertainty, windows, starts, residuals, warnings and a table."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from vipetsc.case.identify import SENSOR_UNITS, IdentifyCase, SensorTable
from vipetsc.identification.growing_windows import GrowingWindows, largest_towards, motion_without, reached_by
from vipetsc.identification.misfit import ROWS
from vipetsc.identification.misfit_profile import ProfileCosts
from vipetsc.identification.uncertainty import (
    DETERMINED,
    SMALLEST,
    Uncertainty,
    errors_with_sensor,
    ljung_box,
    marginal_jacobian,
    quantile,
    uncertainty_of,
)
from vipetsc.io.records import Record
from vipetsc.wording import counted

LAYOUT = {
    "parameter": ("parameter", "1", "what is sought"),
    "other": ("other", "1", "what is sought"),
    "unit": ("parameter", "1", "unit of the parameter"),
    "low": ("parameter", "1", "lower bound"),
    "high": ("parameter", "1", "upper bound"),
    "value": ("parameter", "1", "value found, in the parameter's unit"),
    "standard_error": ("parameter", "1", "standard error, in the parameter's unit; NaN if it is not determined"),
    "interval_low": ("parameter", "1", "lower end of the confidence interval; NaN if not determined"),
    "interval_high": ("parameter", "1", "upper end of the confidence interval; NaN if not determined"),
    "determined": ("parameter", "1", "1 if the data determine the value, otherwise 0"),
    "at_bound": ("parameter", "1", "1 at the upper bound, -1 at the lower one, where there is no interval; else 0"),
    "at_least": (
        "parameter",
        "m",
        "of a clearance that is never reached: the largest displacement there; otherwise NaN",
    ),
    "relative_error": ("parameter", "1", "standard error of the logarithm, or over the range between the bounds"),
    "correlation": ("parameter other", "1", "correlation of the errors"),
    "direction": ("direction", "1", "direction of the parameters, the best determined first"),
    "singular": ("direction", "1", "singular value of the Jacobian over the noise; its inverse is the error along it"),
    "vector": ("direction parameter", "1", "component of a direction"),
    "sensor/cell": ("parameter", "1", "cell (1-based) of the additional sensor that lowers the error most"),
    "sensor/mass": ("parameter", "1", "mass (1-based) of that sensor"),
    "sensor/relative_error": ("parameter", "1", "relative error with that sensor too"),
    "window": ("window", "1", "window of the best start, the last with the final noise"),
    "windows/end": ("window", "s", "largest time of the records' clocks in a window"),
    "windows/impacts": ("window", "1", "contacts of the model in a window"),
    "windows/misfit": ("window", "1", "root mean square of the residuals over the noise"),
    "windows/value": ("window parameter", "1", "value found over a window"),
    "start": ("start", "1", "number of a start; 0 is that of the unknowns"),
    "starts/begin": ("start parameter", "1", "value at the beginning"),
    "starts/value": ("start parameter", "1", "value found; NaN for a start that failed"),
    "starts/deviance": ("start", "1", "minus twice the logarithm of the likelihood, less that of the best start"),
    "starts/valley": ("start", "1", "number of the valley, the deepest is 1; 0 for a start that failed"),
    "channel": ("channel", "1", "sensor of a record"),
    "channels/record": ("channel", "1", "number (1-based) of the record"),
    "channels/unit": ("channel", "1", "unit of the channel"),
    "channels/noise": ("channel", "1", "noise, given or estimated, in the unit of the channel"),
    "channels/is_given": ("channel", "1", "1 if the noise is given, 0 if it is estimated"),
    "channels/misfit": ("channel", "1", "root mean square of the residuals, in the unit of the channel"),
    "channels/size": ("channel", "1", "root mean square of the measured values, in the unit of the channel"),
    "channels/statistic": ("channel", "1", "Q of Ljung and Box of the residuals"),
    "channels/lags": ("channel", "1", "number of autocorrelations in Q"),
    "channels/probability": ("channel", "1", "probability that white noise has as large a Q"),
    "datum": ("datum", "1", "sample of a channel"),
    "data/channel": ("datum", "1", "number (0-based) of the channel"),
    "data/time": ("datum", "s", "time of the record's clock"),
    "data/measured": ("datum", "1", "measured value, in the unit of the channel"),
    "data/model": ("datum", "1", "value of the model, in the unit of the channel"),
    "moving": ("moving", "1", "mass in a record whose initial state is estimated"),
    "initial/record": ("moving", "1", "number (1-based) of a record whose initial state is estimated"),
    "initial/cell": ("moving", "1", "cell (1-based) of a mass"),
    "initial/mass": ("moving", "1", "mass (1-based) in its cell"),
    "initial/displacement": ("moving", "m", "displacement at the beginning of the record"),
    "initial/velocity": ("moving", "m/s", "velocity at the beginning of the record"),
    "initial/displacement_error": ("moving", "m", "standard error of that displacement, with the prior"),
    "initial/velocity_error": ("moving", "m/s", "standard error of that velocity, with the prior"),
    "state_direction": ("state_direction", "1", "direction of an initial state"),
    "initial/of_record": ("state_direction", "1", "number (1-based) of the record of a direction of its state"),
    "initial/singular": (
        "state_direction",
        "1",
        "singular value of the Jacobian by the state's coordinates (1: a mode has the energy measured), over the noise",
    ),
    "place": ("place", "1", "number of a value of a profile"),
    "profile/value": ("parameter place", "1", "value at which a parameter is held"),
    "profile/cost": ("parameter place", "1", "increase of the sum of squared residuals over the noise, others fitted"),
}
# A misfit more than this many times the noise that is given is reported. Intervals are as wide as the noise makes them:
# up to here they are at most a fifth too narrow. By chance the misfit of n samples exceeds the noise by a fraction of
# (2 n)^(-1/2): a fifth is twice that with 50 samples, nine times with 1000.
BEYOND_NOISE = 1.2
# A probability of residuals below this over the number of channels is reported. Of a hundred fits whose residuals are
# white one is reported.
IMPROBABLE = 0.01
# A misfit of which so small a fraction of a channel's samples (FEW) makes this share is not noise: of residuals that
# are normal it takes more than half.
FEW = 0.05
MOST_OF_MISFIT = 0.9
# Residuals below this fraction of their channel are those of rounding and steps, not noise.
EXACT = 1e-6
# Distance of a coordinate from its bound up to which its value is at that bound. A fit stays inside, and comes as near
# as its last steps allow.
AT_BOUND = 1e-6
# The least step of a fit, in standard errors, that shows that the data want a value beyond a bound. A fit that has
# ended inside the bounds has steps of 1e-6.
STEP = 0.01
# Fits whose coordinates differ by at most this, or by three standard errors if these are more, lie in one valley.
SAME_VALLEY = 1e-3
# Masses at most, evenly over the lattice, at which a sensor is tried.
MOST_CANDIDATES = 400
# Derivatives at these masses that are kept in memory, at most: 40 MB, those of a thousand samples by ten parameters.
MOST_NUMBERS = 5_000_000


def identified_values(
    windows: GrowingWindows, z: np.ndarray, fits: list[Record], best: int, profile: ProfileCosts
) -> dict[str, Any]:
    """Return all values by name in ``LAYOUT``, at the best fit's coordinates ``z`` (coordinate,).

    ``fits`` are the records of the starts, of which number ``best`` is the best, ``profile`` the costs about it.
    """
    jacobian = windows.misfit.whole_jacobian(z, windows.last)
    uncertainty = uncertainty_of(marginal_jacobian(jacobian, windows.misfit.count))
    values = _parameter_values(windows, z, jacobian, uncertainty)
    values |= further_sensor_values(windows, z, uncertainty_of(jacobian))
    values |= _window_values(windows, fits[best])
    values |= _start_values(windows, fits, best, uncertainty.errors)
    values |= _channel_values(windows, z)
    values |= _state_values(windows, z, jacobian)

    parameters = windows.misfit.plan.parameters
    cost = windows.misfit.cost(z, windows.last)
    held = np.zeros(profile.places.shape)
    for number, parameter in enumerate(parameters):
        held[number] = [parameter.from_coordinate(x) for x in profile.places[number]]
    return values | {
        "place": np.arange(profile.places.shape[1]),
        "profile/value": held,
        "profile/cost": profile.costs - cost,
    }


def _parameter_values(
    windows: GrowingWindows, z: np.ndarray, jacobian: np.ndarray, uncertainty: Uncertainty
) -> dict[str, Any]:
    """Return parameters with ``uncertainty``, and what is not determined; ``jacobian`` is that of all coordinates."""
    misfit = windows.misfit
    parameters = misfit.plan.parameters
    reached = reached_by(misfit, z, windows.last)
    # A group whose stops are all out of reach is at least as wide as the largest motion towards any.
    at_least = np.array([largest_towards(misfit.plan, parameter, reached) for parameter in parameters])
    for number in np.flatnonzero(np.isnan(at_least)):
        at_least[number] = motion_without(misfit, z, int(number), windows.last, windows.high)

    at_bound = _bounds_met(windows, z, jacobian, uncertainty)
    at_bound[np.isfinite(at_least)] = 0
    confidence = misfit.plan.options.confidence
    width = quantile(confidence, windows.noise_freedom(z)) * uncertainty.errors
    z = z[: misfit.count]
    determined = uncertainty.determined & np.isnan(at_least) & (at_bound == 0)
    slopes = np.array([parameter.slope(x) for parameter, x in zip(parameters, z, strict=True)])
    low = [parameter.from_coordinate(x) for parameter, x in zip(parameters, z - width, strict=True)]
    high = [parameter.from_coordinate(x) for parameter, x in zip(parameters, z + width, strict=True)]
    return {
        "parameter": [parameter.name for parameter in parameters],
        "other": [parameter.name for parameter in parameters],
        "unit": [parameter.unit for parameter in parameters],
        "low": [parameter.low for parameter in parameters],
        "high": [parameter.high for parameter in parameters],
        "value": misfit.values(z),
        "standard_error": np.where(determined, slopes * uncertainty.errors, np.nan),
        "interval_low": np.where(determined, low, np.nan),
        "interval_high": np.where(determined, high, np.nan),
        "determined": determined.astype(int),
        "at_bound": at_bound,
        "at_least": at_least,
        "relative_error": uncertainty.errors,
        "correlation": uncertainty.correlation,
        "direction": np.arange(1, len(z) + 1),
        "singular": uncertainty.singular,
        "vector": uncertainty.directions,
    }


def _bounds_met(windows: GrowingWindows, z: np.ndarray, jacobian: np.ndarray, uncertainty: Uncertainty) -> np.ndarray:
    """Return for each parameter (parameter,) -1 at its lower bound, 1 at its upper one, else 0.

    It is at a bound, or the data want it beyond: the next step of the fit without bounds ends there.
    """
    misfit = windows.misfit
    prior = misfit.prior() @ z
    residuals = np.concatenate([misfit.residuals(z, windows.last), prior])
    step, *_ = np.linalg.lstsq(jacobian, -residuals, rcond=SMALLEST)

    met = np.zeros(misfit.count, int)
    for p in range(misfit.count):
        # A step much smaller than the error is one of rounding.
        moved = z[p]
        if uncertainty.determined[p] and abs(step[p]) > STEP * uncertainty.errors[p]:
            moved += step[p]
        if min(z[p], moved) <= windows.low[p] + AT_BOUND:
            met[p] = -1
        elif max(z[p], moved) >= windows.high[p] - AT_BOUND:
            met[p] = 1
    return met


def _window_values(windows: GrowingWindows, record: Record) -> dict[str, Any]:
    """Return the windows of the best start."""
    rows = record["windows"]
    return {
        "window": np.arange(1, len(rows) + 1),
        "windows/end": [row["end"] for row in rows],
        "windows/impacts": [row["impacts"] for row in rows],
        "windows/misfit": [row["misfit"] for row in rows],
        "windows/value": [windows.misfit.values(np.array(row["coordinates"])) for row in rows],
    }


def _start_values(windows: GrowingWindows, fits: list[Record], best: int, errors: np.ndarray) -> dict[str, Any]:
    """Return all starts with what they found, in valleys; ``errors`` (parameter,) are coordinates' standard errors."""
    misfit = windows.misfit
    starts = misfit.plan.options.starts
    shape = (starts, len(errors))
    values: dict[str, Any] = {
        "start": np.arange(starts),
        "starts/begin": np.full(shape, np.nan),
        "starts/value": np.full(shape, np.nan),
        "starts/deviance": np.full(starts, np.nan),
        "starts/valley": np.zeros(starts, int),
    }

    # Valleys are numbered from the deepest, so that the deepest start comes first.
    fitted = [number for number in range(starts) if "deviance" in fits[number]]
    fitted.sort(key=lambda number: fits[number]["deviance"])
    bottoms: list[np.ndarray] = []
    for number in fitted:
        record = fits[number]
        z = np.array(record["coordinates"])[: len(errors)]
        values["starts/begin"][number] = misfit.values(np.array(record["begin"]))
        values["starts/value"][number] = misfit.values(z)
        values["starts/deviance"][number] = record["deviance"] - fits[best]["deviance"]
        values["starts/valley"][number] = 1 + _valley(z, bottoms, np.maximum(SAME_VALLEY, 3 * errors))
    return values


def _valley(z: np.ndarray, bottoms: list[np.ndarray], distance: np.ndarray) -> int:
    """Return index of the valley whose bottom lies within a ``distance`` (parameter,) of ``z``; a new one is added."""
    for index, bottom in enumerate(bottoms):
        if np.all(abs(z - bottom) <= distance):
            return index
    bottoms.append(z)
    return len(bottoms) - 1


def _state_values(windows: GrowingWindows, z: np.ndarray, jacobian: np.ndarray) -> dict[str, Any]:
    """Return the initial states that are estimated, their errors, and what the data without the prior tell of each."""
    misfit = windows.misfit
    dofs = misfit.plan.base.lattice.unit_cell().dofs
    data_rows = len(jacobian) - len(misfit.prior())
    # Coordinates that nothing determines have no finite variance: the pseudo-inverse leaves them out.
    covariance = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    parts: dict[str, list[np.ndarray]] = {name: [np.zeros(0)] for name in LAYOUT if name.startswith("initial/")}
    for number, state in misfit.states.items():
        displacement, velocity = np.split(state.matrix @ z[state.indices], 2)
        inside = covariance[np.ix_(state.indices, state.indices)]
        errors = np.sqrt(np.einsum("ij,jk,ik->i", state.matrix, inside, state.matrix))
        masses = np.arange(len(displacement))

        # With the state's coordinates first, the marginal Jacobian is theirs while all others are left free.
        others = [p for p in range(misfit.size) if p not in state.indices]
        ordered = jacobian[:data_rows][:, [*state.indices, *others]]
        singular = np.linalg.svd(marginal_jacobian(ordered, len(state.matrix)), compute_uv=False)
        values = {
            "initial/record": np.full(len(masses), number + 1),
            "initial/cell": masses // dofs + 1,
            "initial/mass": masses % dofs + 1,
            "initial/displacement": displacement,
            "initial/velocity": velocity,
            "initial/displacement_error": errors[: len(masses)],
            "initial/velocity_error": errors[len(masses) :],
            "initial/of_record": np.full(len(singular), number + 1),
            "initial/singular": singular,
        }
        for name, part in values.items():
            parts[name].append(part)
    parts["moving"] = [np.arange(sum(map(len, parts["initial/record"])))]
    parts["state_direction"] = [np.arange(sum(map(len, parts["initial/of_record"])))]
    numbers = ("moving", "state_direction", "initial/record", "initial/cell", "initial/mass", "initial/of_record")
    return {name: np.concatenate(part).astype(int if name in numbers else float) for name, part in parts.items()}


def _channel_values(windows: GrowingWindows, z: np.ndarray) -> dict[str, Any]:
    """Return all channels with their residuals."""
    misfit = windows.misfit
    rows: list[dict[str, Any]] = []
    data: list[dict[str, np.ndarray]] = []
    for number, (record, table) in enumerate(zip(misfit.records, misfit.plan.options.records, strict=True)):
        model = misfit.predicted(z, number, windows.last[number])

        for k, sensor in enumerate(table.sensors):
            measured = record.values[:, k]
            residuals = model[:, k] - measured
            white = ljung_box(residuals)
            channel = {
                "channel": f"{number + 1}: {sensor.name}",
                "channels/record": number + 1,
                "channels/unit": SENSOR_UNITS[sensor.quantity],
                "channels/noise": misfit.noise[number][k],
                "channels/is_given": int(sensor.noise is not None),
                "channels/misfit": float(np.sqrt(np.mean(residuals**2))),
                "channels/size": float(np.sqrt(np.mean(measured**2))),
                "channels/statistic": white.statistic,
                "channels/lags": white.lags,
                "channels/probability": white.probability,
            }
            samples = {
                "data/channel": np.full(len(residuals), len(rows)),
                "data/time": record.times,
                "data/measured": measured,
                "data/model": model[:, k],
            }
            rows.append(channel)
            data.append(samples)

    values: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]}
    values |= {name: np.concatenate([samples[name] for samples in data]) for name in data[0]}
    return values | {"datum": np.arange(len(values["data/time"]))}


def warnings_of(data: xr.Dataset) -> list[str]:
    """Return sentences on residuals that the fit does not explain, and on values that the data do not determine."""
    return [
        *_warnings_of_channels(data),
        *_warnings_of_parameters(data),
        *_warnings_of_states(data),
        *_warnings_of_starts(data),
    ]


def _warnings_of_channels(data: xr.Dataset) -> Iterator[str]:
    """Yield sentences on residuals that are larger than the noise, or not white."""
    names = data["channel"].values
    misfit = data["channels/misfit"].values
    ratio = misfit / data["channels/noise"].values
    beyond = (data["channels/is_given"].values == 1) & (ratio > BEYOND_NOISE)
    for name, times in zip(names[beyond], ratio[beyond], strict=True):
        yield f"{name}: the misfit is {times:.2g} times the noise, which does not explain it"

    # One of many channels may well be improbable by chance; residuals of rounding are never white.
    improbable = data["channels/probability"].values < IMPROBABLE / len(names)
    coloured = improbable & (misfit > EXACT * data["channels/size"].values)
    if coloured.any():
        yield (
            f"the residuals are not white ({'; '.join(names[coloured])}): the model lacks something that the data have,"
            " such as another contact law, and the intervals are too narrow"
        )

    channel = data["data/channel"].values
    for number, name in enumerate(names):
        if misfit[number] > EXACT * data["channels/size"].values[number]:
            yield from few_samples(data.isel(datum=channel == number), name)


def few_samples(data: xr.Dataset, name: str) -> Iterator[str]:
    """Yield a sentence on a channel ``name`` whose misfit is that of a few samples of its ``data``."""
    residuals = data["data/model"].values - data["data/measured"].values
    order = np.argsort(-(residuals**2), kind="stable")
    shares = np.cumsum(residuals[order] ** 2) / np.sum(residuals**2)
    count = int(np.searchsorted(shares, MOST_OF_MISFIT)) + 1
    if count > FEW * len(residuals):
        return
    times = data["data/time"].values[order[:count]]
    others = np.sqrt(np.mean(residuals[order[count:]] ** 2))
    unit = data["channels/unit"].values[int(data["data/channel"].values[0])]
    share = 100 * shares[count - 1]
    yield (
        f"{name}: {share:.3g} % of the squared residuals are those of {counted(count, 'sample')} of {len(residuals)}"
        f" between {times.min():.6g} and {times.max():.6g} s, and the others miss by {others:.3g} {unit}; look whether"
        " these samples are outliers, or within an impact that lasts longer or shorter than by the contact law"
    )


def _warnings_of_parameters(data: xr.Dataset) -> Iterator[str]:
    """Yield sentences on clearances that are not reached, and on parameters that are not determined."""
    at_least = data["at_least"].values
    for name, least in zip(data["parameter"].values, at_least, strict=True):
        if np.isfinite(least):
            yield f"{name}: at least {least:.4g} m; nothing touches there"

    parameters = IdentifyCase.of(data).parameters
    at_bound = data["at_bound"].values
    for row in np.flatnonzero(at_bound):
        bound = "upper" if at_bound[row] > 0 else "lower"
        yield (
            f"{data['parameter'].values[row]}: the fit ends at its {bound} bound, so that there is no interval; set"
            " wider bounds if values beyond are possible"
        )

    is_open = (data["determined"].values == 0) & np.isnan(at_least) & (at_bound == 0)
    for row in np.flatnonzero(is_open):
        helped = "no further sensor would do so"
        error = float(data["sensor/relative_error"].values[row])
        if error < DETERMINED:
            place = f"mass {data['sensor/mass'].values[row]} of cell {data['sensor/cell'].values[row]}"
            helped = f"with a sensor at {place} its error would be {100 * error:.2g} %"
            # Coordinates on a linear scale are positions between the bounds.
            if not parameters[row].is_logarithmic:
                helped += " of the range between its bounds"
        yield f"{data['parameter'].values[row]}: the data do not determine it; {helped}"


def _warnings_of_states(data: xr.Dataset) -> Iterator[str]:
    """Yield a sentence on each initial state of which the data determine only a part."""
    for record in np.unique(data["initial/of_record"].values):
        singular = data["initial/singular"].values[data["initial/of_record"].values == record]
        determined = int(np.sum(singular >= 1 / DETERMINED))
        if determined < len(singular):
            yield (
                f"record {record}: of the {len(singular)} numbers of its initial state the data determine {determined};"
                " the others are bounded by the energy that was measured, and the intervals include them"
            )


def _warnings_of_starts(data: xr.Dataset) -> Iterator[str]:
    """Yield a sentence if starts end in different valleys."""
    valley = data["starts/valley"].values
    valleys = int(valley.max(initial=0))
    if valleys > 1:
        second = float(data["starts/deviance"].values[valley == 2].min())
        yield f"{valleys} valleys: the starts lead to different values; the second one's deviance is {second:.3g} more"


def summary_of(data: xr.Dataset) -> str:
    """Return a table of the results, with a line for every parameter, and the warnings."""
    lines = [
        f"{counted(data.sizes['parameter'], 'parameter')} from {counted(data.sizes['datum'], 'value')} of"
        f" {counted(data.sizes['channel'], 'channel')};"
        f" {counted(data.sizes['start'], 'start')}, {counted(int(data['starts/valley'].max()), 'valley')}"
    ]
    lines += parameter_lines(data, IdentifyCase.of(data).options.confidence)
    lines += [_channel_line(data.isel(channel=row)) for row in range(data.sizes["channel"])]
    return "\n".join([*lines, *(f"  warning: {text}" for text in data.attrs["warnings"])])


class _ParameterRow(NamedTuple):
    """Texts in the row of a parameter, or in the headings above them."""

    name: str
    value: str
    error: str
    interval: str
    unit: str

    @classmethod
    def of(cls, parameter: xr.Dataset) -> "_ParameterRow":
        """Return the row of one ``parameter``."""
        value = f"{float(parameter['value']):.7g}"
        error = ""
        if np.isfinite(parameter["at_least"]):
            value = ""
            interval = f"at least {float(parameter['at_least']):.6g}"
        elif parameter["at_bound"]:
            interval = "at its bound"
        elif not parameter["determined"]:
            interval = "not determined"
        else:
            error = f"{float(parameter['standard_error']):.2g}"
            interval = f"{float(parameter['interval_low']):.7g} to {float(parameter['interval_high']):.7g}"
        return cls(str(parameter["parameter"].values), value, error, interval, unit=str(parameter["unit"].values))


def parameter_lines(data: xr.Dataset, confidence: float) -> list[str]:
    """Return a line of headings and one of each parameter, with its interval of that ``confidence``, from 0 to 1.

    ``data`` has the variables of ``LAYOUT`` over (parameter,). Columns are as wide as their longest text.
    """
    rows = [_ParameterRow("parameter", "value", "error", f"{100 * confidence:g} % interval", "unit")]
    rows += [_ParameterRow.of(data.isel(parameter=row)) for row in range(data.sizes["parameter"])]

    # No width is enough for every text: groups of sites are named after all their numbers.
    columns = zip(_ParameterRow._fields, zip(*rows, strict=True), strict=True)
    width = {field: max(map(len, column)) for field, column in columns}
    return [
        f"  {row.name:<{width['name']}}  {row.value:>{width['value']}}  {row.error:>{width['error']}}"
        f"  {row.interval:<{width['interval']}}  {row.unit}"
        for row in rows
    ]


def _channel_line(channel: xr.Dataset) -> str:
    """Return the line of one channel: misfit, noise, whiteness."""
    noise = "noise given" if channel["channels/is_given"] else "noise estimated"
    misfit = f"{float(channel['channels/misfit']):.3g} {channel['channels/unit'].values}"
    white = f"whiteness p = {float(channel['channels/probability']):.2g}"
    return f"  {channel['channel'].values}: misfit {misfit}, {noise} {float(channel['channels/noise']):.3g}, {white}"


def _further_sensor(sensors: Sequence[SensorTable], noise: np.ndarray) -> tuple[str, float]:
    """Return the quantity that one more sensor would measure, and its noise in that quantity's unit.

    They are those of the first of the ``sensors`` that measures motion, and the mean ``noise`` (sensor,) of all that
    measure the same; without any, a velocity with a noise of 1 m/s.
    """
    quantities = [sensor.quantity for sensor in sensors]
    of_motion = [quantity for quantity in quantities if quantity != "force"]
    if not of_motion:
        return "velocity", 1.0
    return of_motion[0], float(np.mean(noise[np.equal(quantities, of_motion[0])]))


def further_sensor_values(windows: GrowingWindows, z: np.ndarray, uncertainty: Uncertainty) -> dict[str, Any]:
    """Return the mass at which one more sensor of the first record with contact would lower each error most.

    ``windows`` is the fit, ``z`` (coordinate,) its solution. The ``uncertainty`` is that of all coordinates: the sensor
    also measures an initial state that is estimated. Returns variables of ``identified.h5`` by name: the cell and the
    mass, both from 1, and the error with the sensor, for each parameter.
    """
    misfit = windows.misfit
    plan = misfit.plan
    tables = plan.options.records
    record = next((number for number, table in enumerate(tables) if table.contact), 0)
    quantity, noise = _further_sensor(tables[record].sensors, misfit.noise[record])

    dofs = plan.base.lattice.unit_cell().dofs
    count = plan.base.lattice.cells * dofs
    candidates = np.arange(0, count, -(-count // MOST_CANDIDATES))
    # Of long records of large lattices every n-th sample, which stands for n of them, is enough.
    times = misfit.records[record].times
    stride = -(-len(times) * len(candidates) * len(z) // MOST_NUMBERS)

    def measured(moved: np.ndarray) -> np.ndarray:
        """Return what sensors at all candidates would measure (sample, mass) at the coordinates ``moved``."""
        response = misfit.respond(moved, record, candidates.tolist(), times[::stride])
        return response.motion[:, :, ROWS[quantity]]

    slopes = np.zeros((len(times[::stride]), len(candidates), len(z)))
    for p in range(len(z)):
        if misfit.acts_on(p, record):
            # Each sample stands for ``stride`` of them, whose information adds: sensitivities grow with its root.
            slopes[:, :, p] = np.sqrt(stride) * misfit.difference(z, p, measured)
    errors = errors_with_sensor(uncertainty, slopes, noise)[:, : misfit.count]
    chosen = errors.argmin(axis=0)
    return {
        "sensor/cell": candidates[chosen] // dofs + 1,
        "sensor/mass": candidates[chosen] % dofs + 1,
        "sensor/relative_error": errors.min(axis=0),
    }
