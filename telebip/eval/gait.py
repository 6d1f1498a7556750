"""The rhythm of the feet, from the forces on them: period, regularity, symmetry, duty factor, double support, peaks.

Forces are those of a `Rollout`: means over a policy step (20 ms), so that a 5 ms impact counts for what it carries.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

CONTACT = 0.05  # body weights: a foot that carries more is on the ground
LONGEST_PERIOD = 1.5  # s, the longest one looked for
RHYTHM = 0.3  # autocorrelation below which there is no period to speak of
HARMONICS = 8  # of the gait frequency, in the comparison of left and right


def summarise_gait(
    foot_force: Array, knee_pos: Array, speed: float, weight: float, step_dt: float, clock: float
) -> dict[str, float]:
    """Describe how a robot steps: means over worlds, by name.

    Args:
        foot_force: normal forces on the right and the left foot [N], (steps, num_envs, 2).
        knee_pos: positions of the prismatic knees [m], (steps, num_envs, knees); there may be none.
        speed: mean forward speed [m/s].
        weight: m g [N].
        step_dt: time between rows [s].
        clock: period of the phase signals [s], by which left and right are compared where the feet have no rhythm.
    """
    period, regularity = rhythm(foot_force, step_dt)
    stride = clock if np.isnan(period) else period
    down = foot_force > CONTACT * weight
    steps = max(1, round(stride / step_dt))
    return {
        "period_s": period,  # of one stride (two steps); NaN without a rhythm
        "regularity": regularity,  # see `rhythm` [-]
        "symmetry": symmetry_index(foot_force, stride, step_dt),  # [-]
        "duty_factor": float(down.mean()),  # share of the time that a foot is on the ground [-]
        "double_support": float(down.all(-1).mean()),  # share of the time that both are [-]
        "flight": float((~down).all(-1).mean()),  # share of the time that neither is [-]
        "peak_force_bw": float(_strides(foot_force, steps).max(1).mean()) / weight,  # of a foot, mean over strides
        "stride_length_m": abs(speed) * stride,
        # travel that a prismatic knee uses, mean over strides; NaN without one
        "knee_stroke_m": float(np.ptp(_strides(knee_pos, steps), axis=1).mean()) if knee_pos.size else float("nan"),
    }


def rhythm(foot_force: Array, step_dt: float) -> tuple[float, float]:
    r"""Period of the gait and its regularity, from the autocorrelation of d = q_rf - q_lf.

        R(k) = mean_t d(t) d(t + k) / mean_t d(t)^2,    period = k* dt,    regularity = R(k*)

    with k* the first of the high peaks (at least 0.9 of the highest), refined between samples by a parabola. d alternates in
    sign within one stride, so that one stride, not one step, is its period. Regularity is 1 where every stride repeats the
    one before.

    Args:
        foot_force: normal forces on the right and the left foot [N], (steps, num_envs, 2).
        step_dt: dt, time between rows [s].

    Returns:
        Period [s], median over the worlds that have one, NaN if there are fewer than two periods or half of the worlds have
        no rhythm (R < 0.3); regularity [-], mean over worlds, 0 for those without a peak.
    """
    lags = min(round(LONGEST_PERIOD / step_dt), len(foot_force) // 2)
    if lags < 3:
        return float("nan"), float("nan")
    d = (foot_force[..., 0] - foot_force[..., 1]).astype(float)
    d -= d.mean(0)
    energy = (d * d).mean(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.array([(d[: len(d) - k] * d[k:]).mean(0) / energy for k in range(lags + 1)])
    found = [_first_peak(column) for column in correlation.T]
    periods = [lag * step_dt for lag, height in found if height > RHYTHM]
    period = float(np.median(periods)) if 2 * len(periods) > len(found) else float("nan")
    return period, float(np.mean([height for _, height in found]))


def symmetry_index(foot_force: Array, period: float, step_dt: float) -> float:
    r"""How well the left foot does, half a period later, what the right foot does.

        S = 2 <c_r, c_l'> / (<c_r, c_r> + <c_l', c_l'>) = 1 - ||c_r - c_l'||^2 / (||c_r||^2 + ||c_l'||^2)

    c_r and c_l' are the Fourier coefficients of q_rf(t) and q_lf(t + T/2) at the first harmonics of the gait frequency,
    fitted by least squares; the shift changes the sign of the odd ones. S is 1 for a perfectly alternating gait, falls with
    differences of timing, shape and size alike, and is 0 where one foot alone carries.

    Args:
        foot_force: normal forces on the right and the left foot [N], (steps, num_envs, 2).
        period: T [s].
        step_dt: time between rows [s].

    Returns:
        S, mean over worlds [-].
    """
    angle = 2.0 * np.pi / period * step_dt * np.arange(len(foot_force))
    orders = np.arange(1, min(HARMONICS, int(0.5 * period / step_dt - 1e-9)) + 1)
    waves = np.outer(angle, orders)
    basis = np.concatenate([np.full((len(angle), 1), np.sqrt(0.5)), np.cos(waves), np.sin(waves)], axis=1)
    right, left = (np.linalg.lstsq(basis, foot_force[..., foot].astype(float), rcond=None)[0] for foot in range(2))
    left *= np.concatenate([[1.0], (-1.0) ** orders, (-1.0) ** orders])[:, None]
    energy = (right**2 + left**2).sum(0)
    return float((2.0 * (right * left).sum(0) / np.where(energy > 0.0, energy, 1.0)).mean())


def _first_peak(correlation: Array) -> tuple[float, float]:
    """Return lag [samples] and height of the first high peak, (NaN, 0) if there is none."""
    inner = correlation[1:-1]
    peaks = 1 + np.flatnonzero((inner > correlation[:-2]) & (inner >= correlation[2:]) & (inner > 0.0))
    if not len(peaks):
        return float("nan"), 0.0
    k = peaks[np.argmax(correlation[peaks] >= 0.9 * correlation[peaks].max())]
    left, middle, right = correlation[k - 1 : k + 2]
    offset = 0.5 * (left - right) / (left - 2.0 * middle + right)
    return float(k + offset), float(middle - 0.25 * (left - right) * offset)


def _strides(signal: Array, steps: int) -> Array:
    """Cut (time, ...) into whole strides, (strides, steps, ...)."""
    count = max(1, len(signal) // steps)
    return signal[: count * steps].reshape(count, -1, *signal.shape[1:])
