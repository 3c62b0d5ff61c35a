# SPDX-License-Identifier: Apache-2.0
"""Lens models on the normalised plane (x / z, y / z): pure functions of points and coefficients.

`radtan` takes k1 k2 p1 p2 [k3 [k4 k5 k6]] in OpenCV's order; `equidistant` (Kannala & Brandt
2006) takes k1 k2 k3 k4. Both are `p * f(|p|^2)`, radtan with a tangential part added. Beyond
`field_limit` a model folds back: what it gives there is not the lens's image.
"""

import functools
import math

import numpy as np
from numpy.polynomial import Polynomial

from edge.types import F64

NONE, RADTAN, EQUIDISTANT = "none", "radtan", "equidistant"
COEFFICIENT_COUNTS = {NONE: (0,), RADTAN: (4, 5, 8), EQUIDISTANT: (4,)}

# Rays further off the axis are never asked for: their tangent leaves every image.
_MAX_ANGLE_RAD = math.radians(89.0)
_TABLE_SIZE = 1024
_MAX_NEWTON_STEPS = 12
_CONVERGED = 1e-11  # on the normalised plane; 1e-8 px for any lens
# A closed form loses digits below this squared radius; its limit is good to as many.
_AXIS_BELOW = 1e-7


def distort(model: str, coefficients: tuple[float, ...], points: F64) -> F64:
    """Distorted points (n, 2) of ideal points (n, 2), both on the normalised plane."""
    if model == NONE:
        return np.array(points, np.float64)
    x, y = points[:, 0], points[:, 1]
    s = x * x + y * y
    f = _factor(model, coefficients, s)
    distorted = np.stack((x * f, y * f), axis=1)
    if model == RADTAN:
        p1, p2 = coefficients[2:4]
        distorted[:, 0] += 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
        distorted[:, 1] += 2.0 * p2 * x * y + p1 * (s + 2.0 * y * y)
    return distorted


def undistort(model: str, coefficients: tuple[float, ...], points: F64) -> F64:
    """Ideal points (n, 2) of distorted points (n, 2); nan where the model has no inverse.

    The radial part is looked up first, so that Newton's method starts close at any angle.
    """
    if model == NONE:
        return np.array(points, np.float64)
    table_r, table_rd = _radius_table(model, coefficients)
    rd = np.hypot(points[:, 0], points[:, 1])
    stretch = np.interp(rd, table_rd, table_r) / np.maximum(rd, 1e-300)
    ideal = points * np.where(rd > 0.0, stretch, 1.0)[:, None]
    with np.errstate(all="ignore"):  # a point without an inverse may run away; it ends as nan
        for _ in range(_MAX_NEWTON_STEPS):
            error = distort(model, coefficients, ideal) - points
            if not np.any(np.abs(error) > _CONVERGED):
                break
            ideal = ideal - _solve(jacobian(model, coefficients, ideal), error)
        error = np.abs(distort(model, coefficients, ideal) - points).max(axis=1, initial=0.0)
        outside = np.hypot(ideal[:, 0], ideal[:, 1]) > table_r[-1]
    ideal[~(error <= _CONVERGED) | outside] = np.nan
    return ideal


def jacobian(model: str, coefficients: tuple[float, ...], points: F64) -> F64:
    """Slope (n, 2, 2) of `distort` by its points (n, 2)."""
    x, y = points[:, 0], points[:, 1]
    J = np.zeros((len(points), 2, 2))
    if model == NONE:
        J[:] = np.eye(2)
        return J
    f, df = _radial(model, coefficients, x * x + y * y)
    J[:, 0, 0] = f + 2.0 * x * x * df
    J[:, 1, 1] = f + 2.0 * y * y * df
    J[:, 0, 1] = J[:, 1, 0] = 2.0 * x * y * df
    if model == RADTAN:
        p1, p2 = coefficients[2:4]
        J[:, 0, 0] += 2.0 * p1 * y + 6.0 * p2 * x
        J[:, 1, 1] += 2.0 * p2 * x + 6.0 * p1 * y
        mixed = 2.0 * (p1 * x + p2 * y)
        J[:, 0, 1] += mixed
        J[:, 1, 0] += mixed
    return J


@functools.lru_cache(maxsize=16)
def field_limit(model: str, coefficients: tuple[float, ...]) -> float:
    """Ideal radius up to which the distorted radius grows: beyond it the model folds back."""
    if model == RADTAN:
        numerator, denominator = _radtan_polynomials(coefficients)
        s = Polynomial([0.0, 1.0])
        slope = (numerator + 2.0 * s * numerator.deriv()) * denominator
        slope -= 2.0 * s * numerator * denominator.deriv()
        limit = math.sqrt(min(_first_positive_root(slope), _first_positive_root(denominator)))
        return min(limit, math.tan(_MAX_ANGLE_RAD))
    if model == EQUIDISTANT:
        slope = Polynomial([1.0, *(k * (2 * i + 3) for i, k in enumerate(coefficients))])
        return math.tan(min(math.sqrt(_first_positive_root(slope)), _MAX_ANGLE_RAD))
    return math.tan(_MAX_ANGLE_RAD)


@functools.lru_cache(maxsize=16)
def _radius_table(model: str, coefficients: tuple[float, ...]) -> tuple[F64, F64]:
    """Ideal and distorted radii up to the fold, both increasing, even in angle."""
    r = np.tan(np.linspace(0.0, math.atan(field_limit(model, coefficients)), _TABLE_SIZE))
    return r, r * _factor(model, coefficients, r * r)


def _factor(model: str, coefficients: tuple[float, ...], s: F64) -> F64:
    """Radial factor f (n,) at squared ideal radii s (n,)."""
    if model == RADTAN:
        numerator, denominator = _radtan_polynomials(coefficients)
        return _value(numerator, s) / _value(denominator, s)
    theta = np.arctan(np.sqrt(s))
    near_axis = s < _AXIS_BELOW
    safe_s = np.where(near_axis, 1.0, s)
    bend = _value(Polynomial([1.0, *coefficients]), theta * theta)
    factor: F64 = np.where(near_axis, 1.0 - s / 3.0, theta / np.sqrt(safe_s)) * bend
    return factor


def _radial(model: str, coefficients: tuple[float, ...], s: F64) -> tuple[F64, F64]:
    """Return the radial factor f and df/ds, both (n,), at squared ideal radii s (n,)."""
    f = _factor(model, coefficients, s)
    if model == RADTAN:
        _, denominator = _radtan_polynomials(coefficients)
        of_numerator, of_denominator = _radtan_slopes(coefficients)
        change = _value(of_numerator, s) - f * _value(of_denominator, s)
        return f, change / _value(denominator, s)
    theta = np.arctan(np.sqrt(s))
    bend = Polynomial([1.0, *coefficients])
    t = theta * theta
    near_axis = s < _AXIS_BELOW
    safe_s = np.where(near_axis, 1.0, s)
    slope = _value(bend, t) + 2.0 * t * _value(bend.deriv(), t)
    df = np.where(near_axis, coefficients[0] - 1.0 / 3.0, (slope / (1.0 + s) - f) / (2.0 * safe_s))
    return f, df


def _value(polynomial: Polynomial, x: F64) -> F64:
    """Its value at each x (n,), by Horner's rule: calling it takes ten times as long for few."""
    *lower, value = polynomial.coef.tolist()
    result: F64 = np.full_like(x, value)
    for coefficient in reversed(lower):
        result = coefficient + result * x
    return result


# Kept, as numpy takes longer to make one than to evaluate it at a fix's points.
@functools.lru_cache(maxsize=16)
def _radtan_polynomials(coefficients: tuple[float, ...]) -> tuple[Polynomial, Polynomial]:
    k1, k2, _, _, k3, k4, k5, k6 = (*coefficients, *(0.0,) * (8 - len(coefficients)))
    return Polynomial([1.0, k1, k2, k3]).trim(), Polynomial([1.0, k4, k5, k6]).trim()


@functools.lru_cache(maxsize=16)
def _radtan_slopes(coefficients: tuple[float, ...]) -> tuple[Polynomial, Polynomial]:
    numerator, denominator = _radtan_polynomials(coefficients)
    return numerator.deriv(), denominator.deriv()


def _first_positive_root(polynomial: Polynomial) -> float:
    roots = polynomial.trim().roots()
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
    return float(real.min()) if len(real) else math.inf


def _solve(J: F64, error: F64) -> F64:
    """Solve n systems of two equations: J (n, 2, 2), error (n, 2)."""
    determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    step = np.stack(
        (
            J[:, 1, 1] * error[:, 0] - J[:, 0, 1] * error[:, 1],
            J[:, 0, 0] * error[:, 1] - J[:, 1, 0] * error[:, 0],
        ),
        axis=1,
    )
    return np.asarray(step / determinant[:, None], np.float64)
