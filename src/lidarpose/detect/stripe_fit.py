"""The stripe's centre line to a few hundredths of a pixel, fitted in a narrow band of the raw image.

See `laser_stripe` for the model. Here the image is looked at along a scan coordinate u (x, or y for steep stripes), one
profile in v for each whole u. Each profile has its own height A, centre c and background; the stripe's width and how
much light dark squares send back are common to all. Gauss and Newton's method, all profiles at once; the common
unknowns by the Schur complement. The noise's variance, r^2 + g * level + (s * level)^2 (reading, shots, speckle), is
learnt from the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.detect.albedo import PanelAlbedo
from lidarpose.detect.stripe_search import CoarseLine, PanelView
from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.geometry.robust import mad_sigma, tukey_weights
from lidarpose.model.image import GrayImage
from lidarpose.model.observation import StripePoints

# Profiles that are merged into one point: neighbours share the lens's blur and the laser's speckle.
_BLOCK = 4
_MIN_POINTS = 8
# Half-height of the band in which the coarse line is made fine, pixels.
_FIRST_HALF = 12
# A profile whose own centre is worse than this tells nothing.
_WORST_SIGMA_PX = 0.8


@dataclass(frozen=True, eq=False)
class StripeFit:
    """Points, and what the fit learnt on the way (for tests and reports).

    Attributes
    ----------
    width_px
        Standard deviation of the stripe's profile across, lens included.
    dark_ratio
        Light sent back by dark squares against light ones, at the laser's colour.
    inflation
        By how much the scatter about a smooth curve exceeds what the noise explains (1: not at all); it is in the
        points' standard deviations.
    """

    points: StripePoints
    width_px: float
    dark_ratio: float
    inflation: float


@dataclass(frozen=True, eq=False)
class _Curve:
    """v as a polynomial of u, in (u - middle) / half."""

    coefficients: FloatArray
    middle: float
    half: float

    def at(self, u: FloatArray) -> FloatArray:
        return np.asarray(np.polynomial.polynomial.polyval((u - self.middle) / self.half, self.coefficients))

    def slope(self, u: FloatArray) -> FloatArray:
        derivative = np.polynomial.polynomial.polyder(self.coefficients) / self.half
        return np.asarray(np.polynomial.polynomial.polyval((u - self.middle) / self.half, derivative))


@dataclass(frozen=True, eq=False)
class _Band:
    """Profiles along the stripe.

    u : (N,); v : (N, P) pixel coordinates; values, bright : (N, P) grey levels; good : (N, P) pixels that count;
    ambient : (N, P) light that was taken out of the values.
    """

    u: FloatArray
    v: FloatArray
    values: FloatArray
    bright: FloatArray
    good: BoolArray
    ambient: FloatArray


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Of each profile, on the curve: cosine and sine of the stripe's inclination (N,), grid coordinates (N, 2) and
    their gradient (N, 2, 2) by (u, v)."""

    cosine: FloatArray
    sine: FloatArray
    grid: FloatArray
    gradient: FloatArray


@dataclass(frozen=True, eq=False)
class _State:
    height: FloatArray
    centre: FloatArray
    background: FloatArray
    width: float
    dark_ratio: float
    noise: tuple[float, float, float]


def fit_stripe(view: PanelView, image: GrayImage, line: CoarseLine, limit: float) -> StripeFit | str:
    """Fit the stripe near `line`; `limit` is the grey level at which the sensor saturates. A string says why not."""
    straight = _Curve(np.array([line.intercept, line.slope]), 0.0, 1.0)
    u = _usable_range(view, line, straight)
    if len(u) < _MIN_POINTS:
        return "no stripe on the panel: the bright line leaves the squares"
    band = _cut(view, image, line.steep, u, straight, _FIRST_HALF, limit)
    first = _first_curve(band, line, straight)
    if isinstance(first, str):
        return first
    curve, width = first
    for _ in range(2):
        half = int(np.clip(np.ceil(3.5 * width * np.sqrt(1.0 + curve.slope(u) ** 2).max() + 1.5), 4, 24))
        geometry = _geometry(view.albedo, line.steep, u, curve)
        cut = _cut(view, image, line.steep, u, curve, half, limit)
        band, state = _start(cut, geometry, curve, view, width)
        for _ in range(3):
            state, information = _step(band, geometry, view.albedo, state, curve)
        smooth = _smooth(band, geometry, state, information)
        if isinstance(smooth, str):
            return smooth
        curve, weight, residual = smooth
        if abs(np.log(state.width / width)) < 0.1:
            break
        width = state.width
    return _points(band, geometry, curve, residual, weight, line.steep, state)


def _usable_range(view: PanelView, line: CoarseLine, curve: _Curve) -> FloatArray:
    """Whole u (N,) near the coarse line's range whose centre lies in a usable square."""
    axis = 1 if line.steep else 0
    slack = 4 * view.factor
    first = max(int(np.floor(line.start)) - slack, view.low[axis])
    last = min(int(np.ceil(line.end)) + slack, view.high[axis] - 1)
    u = np.arange(first, last + 1, dtype=np.float64)
    v = curve.at(u)
    across = 1 - axis
    inside = (v > view.low[across] + 3) & (v < view.high[across] - 4)
    u, v = u[inside], v[inside]
    if len(u) == 0:
        return u
    grid = view.albedo.grid_map.grid(_pixels(u, v, line.steep))
    return u[view.albedo.is_usable(grid)]


def _pixels(u: FloatArray, v: FloatArray, steep: bool) -> FloatArray:
    return np.stack([v, u] if steep else [u, v], axis=-1)


def _cut(
    view: PanelView, image: GrayImage, steep: bool, u: FloatArray, curve: _Curve, half: int, limit: float
) -> _Band:
    """Profiles of 2 half + 1 pixels about the curve."""
    v = np.round(curve.at(u)).astype(int)[:, None] + np.arange(-half, half + 1)
    across = 0 if steep else 1
    inside = (v >= view.low[across]) & (v < view.high[across])
    safe = np.clip(v, view.low[across], view.high[across] - 1)
    along = u.astype(int)[:, None]
    rows, columns = (along, safe) if steep else (safe, along)
    values = image[rows, columns]
    bright = view.bright[rows - view.low[1], columns - view.low[0]]
    good = inside & (values < 0.98 * limit)
    return _Band(u, v.astype(float), values.astype(float), bright.astype(float), good, np.zeros(values.shape))


def _first_curve(band: _Band, line: CoarseLine, straight: _Curve) -> tuple[_Curve, float] | str:
    """A curve within about a pixel, from the brightest pixel of each profile, and the stripe's rough width."""
    rest = band.values - line.ambient_share * band.bright
    rest = rest - np.median(rest, axis=1, keepdims=True)
    smooth = rest.copy()
    smooth[:, 1:-1] = 0.25 * rest[:, :-2] + 0.5 * rest[:, 1:-1] + 0.25 * rest[:, 2:]
    peak = np.argmax(smooth, axis=1)
    rows = np.arange(len(peak))
    height = smooth[rows, peak]
    strong = height > 0.4 * np.percentile(height, 75)
    offset = band.v[rows, peak] - straight.at(band.u)
    weight = np.where(strong, 1.0, 0.0)
    curve = straight
    for reach in (8.0, 4.0, 2.5):
        near = weight * (np.abs(band.v[rows, peak] - curve.at(band.u)) <= reach)
        if np.count_nonzero(near) < _MIN_POINTS:
            return "no stripe on the panel: the bright line is not a narrow ridge"
        curve = _fit_curve(band.u, straight.at(band.u) + offset, near, degree=2)
    chosen = rows[near > 0]
    window = np.clip(peak[chosen][:, None] + np.arange(-9, 10), 0, rest.shape[1] - 1)
    area = np.maximum(rest[chosen[:, None], window], 0.0).sum(axis=1) / height[chosen]
    cosine = 1.0 / np.sqrt(1.0 + curve.slope(band.u[chosen]) ** 2)
    return curve, float(np.clip(np.median(area * cosine) / np.sqrt(2.0 * np.pi), 0.6, 6.0))


def _fit_curve(u: FloatArray, v: FloatArray, weight: FloatArray, degree: int) -> _Curve:
    used = weight > 0
    middle, half = float(u[used].min() + u[used].max()) / 2.0, max(float(np.ptp(u[used])) / 2.0, 1.0)
    root = np.sqrt(weight[used])
    design = np.polynomial.polynomial.polyvander((u[used] - middle) / half, degree)
    coefficients = np.linalg.lstsq(design * root[:, None], v[used] * root, rcond=None)[0]
    return _Curve(coefficients, middle, half)


def _geometry(albedo: PanelAlbedo, steep: bool, u: FloatArray, curve: _Curve) -> _Geometry:
    slope = curve.slope(u)
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    grid = albedo.grid_map.grid(_pixels(u, curve.at(u), steep))
    gradient = np.linalg.inv(albedo.grid_map.jacobian(grid))
    if steep:
        gradient = gradient[:, :, ::-1]
    return _Geometry(cosine, slope * cosine, grid, gradient)


def _start(band: _Band, geometry: _Geometry, curve: _Curve, view: PanelView, width: float) -> tuple[_Band, _State]:
    """Take the ambient light out, and guess heights and backgrounds."""
    centre = curve.at(band.u)
    distance = (band.v - centre[:, None]) * geometry.cosine[:, None]
    flank = band.good & (np.abs(distance) > 3.0 * width)
    ambient = _ambient(band, flank)
    rest = band.values - ambient
    count = np.maximum(flank.sum(axis=1), 1)
    background = (rest * flank).sum(axis=1) / count
    core = band.good & (np.abs(distance) < width)
    height = ((rest - background[:, None]) * core).sum(axis=1) / np.maximum(core.sum(axis=1), 1) / 0.85
    reading = mad_sigma((rest - background[:, None])[flank]) if flank.any() else 1.0
    r = float(np.clip(np.median(view.albedo.dark / view.albedo.light), 0.0, 0.95))
    state = _State(np.maximum(height, 1.0), centre, background, width, r, (max(reading, 0.3) ** 2, 0.0, 0.0))
    return replace(band, values=rest, ambient=ambient), state


def _ambient(band: _Band, flank: BoolArray) -> FloatArray:
    """The bright image times a share that changes slowly along the stripe, from the pixels beside it."""
    count = np.maximum(flank.sum(axis=1, keepdims=True), 1)
    values, bright = (
        np.where(flank, x - (x * flank).sum(axis=1, keepdims=True) / count, 0.0) for x in (band.values, band.bright)
    )
    s = (band.u - band.u.mean()) / max(np.ptp(band.u) / 2.0, 1.0)
    powers = np.stack([np.ones_like(s), s, s**2], axis=1)
    own, cross = (bright**2).sum(axis=1), (bright * values).sum(axis=1)
    normal = (powers * own[:, None]).T @ powers
    # Flat profiles tell nothing: a weak pull towards no ambient light.
    share = np.linalg.solve(normal + np.eye(3) * (1e-6 * np.trace(normal) + 1.0), powers.T @ cross)
    return np.asarray((powers @ share)[:, None] * band.bright)


def _step(
    band: _Band, geometry: _Geometry, albedo: PanelAlbedo, state: _State, curve: _Curve
) -> tuple[_State, FloatArray]:
    """One Gauss-Newton step; also the information (N,) on each centre, 1 / px^2 along v."""
    distance = (band.v - state.centre[:, None]) * geometry.cosine[:, None]
    light, dark = _shares(band, geometry, albedo, state, curve, distance)
    bell = np.exp(-0.5 * (distance / state.width) ** 2)
    by_height = bell * (light + state.dark_ratio * dark)
    signal = state.height[:, None] * by_height
    residual = band.values - signal - state.background[:, None]
    level = np.maximum(signal + band.ambient + state.background[:, None], 0.0)
    r2, g, s2 = state.noise
    weight = band.good / (r2 + g * level + s2 * signal**2)
    J = np.stack(
        [
            by_height,
            signal * distance * (geometry.cosine[:, None] / state.width**2),
            np.ones_like(signal),
            signal * (distance / state.width) ** 2,
            state.height[:, None] * bell * dark,
        ],
        axis=-1,
    )
    weighted = np.swapaxes(J * weight[..., None], 1, 2)
    normal = weighted @ J
    right = (weighted @ residual[..., None])[..., 0]
    # Profiles without light keep to the curve: a pull of 1.5 px, nothing against a real profile's hundredths.
    normal[:, 1, 1] += 1.0 / 1.5**2
    right[:, 1] += (curve.at(band.u) - state.centre) / 1.5**2
    normal[:, 0, 0] += 1e-9
    normal[:, 2, 2] += 1e-9
    inverse = np.linalg.inv(normal[:, :3, :3])
    mixed = normal[:, :3, 3:]
    common = (normal[:, 3:, 3:] - np.swapaxes(mixed, 1, 2) @ inverse @ mixed).sum(axis=0) + np.diag([1e-6, 100.0])
    goal = (right[:, 3:] - (np.swapaxes(mixed, 1, 2) @ inverse @ right[:, :3, None])[..., 0]).sum(axis=0)
    shared = np.clip(np.linalg.solve(common, goal), [-0.3, -0.1], [0.3, 0.1])
    own = (inverse @ (right[:, :3] - mixed @ shared)[..., None])[..., 0]
    moved = _State(
        np.maximum(state.height + own[:, 0], 1e-3),
        state.centre + np.clip(own[:, 1], -1.0, 1.0),
        state.background + own[:, 2],
        float(np.clip(state.width * np.exp(shared[0]), 0.4, 10.0)),
        float(np.clip(state.dark_ratio + shared[1], 0.0, 1.0)),
        _learn_noise(residual[band.good], level[band.good], signal[band.good], state.noise),
    )
    return moved, np.asarray(1.0 / inverse[:, 1, 1])


def _shares(
    band: _Band, geometry: _Geometry, albedo: PanelAlbedo, state: _State, curve: _Curve, distance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Share (N, P) of light, and of dark, surface that each pixel sees through stripe and lens (see `laser_stripe`)."""
    blur2 = min(albedo.blur_px, state.width) ** 2
    thickness = 1.0 - blur2 / state.width**2
    cosine, sine = geometry.cosine[:, None], geometry.sine[:, None]
    along_u = (1.0 - thickness) * distance * sine
    along_v = (band.v - curve.at(band.u)[:, None]) - (1.0 - thickness) * distance * cosine
    where = []
    edges = []
    for k in (0, 1):
        g_u, g_v = geometry.gradient[:, k, 0, None], geometry.gradient[:, k, 1, None]
        where.append(geometry.grid[:, k, None] + g_u * along_u + g_v * along_v)
        across, along = -g_u * sine + g_v * cosine, g_u * cosine + g_v * sine
        edges.append(np.sqrt(blur2 * (thickness * across**2 + along**2)))
    sign = albedo.sign_at(where[0], where[1], edges[0], edges[1])
    return 0.5 * (1.0 + sign), 0.5 * (1.0 - sign)


def _learn_noise(
    residual: FloatArray, level: FloatArray, signal: FloatArray, before: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Variance as r^2 + g * level + s^2 * signal^2 (all >= 0), from the residuals sorted by the signal."""
    if len(residual) < 200:
        return before
    from scipy.optimize import nnls

    order = np.argsort(signal)
    bins = np.array_split(order, 10)
    # A quarter of the pixels' freedom went into the fit at most; medians are deaf to what does not belong.
    variance = np.array([max((1.4826 * np.median(np.abs(residual[b]))) ** 2, 0.05) for b in bins])
    design = np.array([[1.0, level[b].mean(), (signal[b] ** 2).mean()] for b in bins])
    solution, _ = nnls(design / variance[:, None], np.ones(len(bins)))
    return (max(float(solution[0]), 0.05), float(solution[1]), float(solution[2]))


def _smooth(
    band: _Band, geometry: _Geometry, state: _State, information: FloatArray
) -> tuple[_Curve, FloatArray, FloatArray] | str:
    """A smooth curve through the centres; the weights (N,) that are left, and residuals (N,)."""
    sigma = 1.0 / np.sqrt(information)
    weight = np.where(sigma * geometry.cosine < _WORST_SIGMA_PX, information, 0.0)
    robust = weight
    degree = 3 if np.count_nonzero(weight) > 60 else 2
    for _ in range(4):
        if np.count_nonzero(robust) < _MIN_POINTS:
            return "no stripe on the panel: too few profiles show it"
        curve = _fit_curve(band.u, state.centre, robust, degree)
        residual = state.centre - curve.at(band.u)
        standardised = residual / sigma
        scale = max(mad_sigma(standardised[weight > 0], centred=True), 1.0)
        robust = weight * tukey_weights(standardised / scale)
    kept = np.where(np.abs(standardised) < 4.0 * scale, weight, 0.0)
    spread = mad_sigma((residual * geometry.cosine)[kept > 0], centred=True)
    if spread > 0.5 * max(state.width, 1.0):
        return "the bright line on the panel is not the narrow straight line that a laser makes"
    return curve, kept, residual


def _points(
    band: _Band,
    geometry: _Geometry,
    curve: _Curve,
    residual: FloatArray,
    weight: FloatArray,
    steep: bool,
    state: _State,
) -> StripeFit | str:
    """Merge blocks of neighbouring profiles; their scatter about the curve corrects what the noise model states."""
    block = np.floor(band.u / _BLOCK).astype(int)
    block -= block[0]
    total = np.bincount(block, weight)
    enough = (np.bincount(block, weight > 0) >= _BLOCK // 2) & (total > 0)
    if enough.sum() < _MIN_POINTS:
        return "no stripe on the panel: too few profiles show it"
    safe = np.where(enough, total, 1.0)
    mean = [(np.bincount(block, weight * x) / safe)[enough] for x in (band.u, residual, geometry.cosine, geometry.sine)]
    u, offset, cosine, sine = mean
    length = np.hypot(cosine, sine)
    cosine, sine = cosine / length, sine / length
    sigma = 1.0 / np.sqrt(total[enough])
    freedom = np.sqrt(max(len(u) - 4, 1) / len(u))
    inflation = max(mad_sigma(offset / sigma, centred=True) / freedom, 1.0)
    v = curve.at(u) + offset
    points = StripePoints(
        _pixels(u, v, steep),
        np.stack([cosine, -sine] if steep else [-sine, cosine], axis=-1),
        sigma * inflation * cosine,
    )
    return StripeFit(points, state.width, state.dark_ratio, inflation)
