"""What a fit says, computed again from its surface by SciPy's splines and the textbook's definitions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.surface import NurbsSurface

Values = NDArray[np.float64]


def derivatives(surface: NurbsSurface, u: Values, v: Values) -> dict[str, Values]:
    """S and its first and second partial derivatives, (N, 3) each, by the quotient rule on A = w S."""
    net = np.concatenate(
        [surface.control_points_m * surface.weights[..., None], surface.weights[..., None]], -1
    )
    spline = NdBSpline((surface.knots_v, surface.knots_u), net, k=surface.degree[::-1])
    places = np.stack([v, u], axis=-1).astype(float)
    orders = {"": (0, 0), "u": (0, 1), "v": (1, 0), "uu": (0, 2), "uv": (1, 1), "vv": (2, 0)}
    A, w = {}, {}
    for name, order in orders.items():
        homogeneous = spline(places, nu=order)
        A[name], w[name] = homogeneous[:, :3], homogeneous[:, 3:]
    S = {"": A[""] / w[""]}
    for a in ("u", "v"):
        S[a] = (A[a] - w[a] * S[""]) / w[""]
    for a, b in ("uu", "uv", "vv"):
        S[a + b] = (A[a + b] - w[a] * S[b] - w[b] * S[a] - w[a + b] * S[""]) / w[""]
    return S


def principal_curvatures(surface: NurbsSurface, u: Values, v: Values) -> tuple[Values, Values]:
    """The eigenvalues of the shape operator I^-1 II, the larger first."""
    S = derivatives(surface, u, v)
    normal = np.cross(S["u"], S["v"])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    def form(*pairs: tuple[Values, Values]) -> Values:
        a, b, c = ((one * other).sum(axis=1) for one, other in pairs)
        return np.stack([np.stack([a, b], -1), np.stack([b, c], -1)], -2)

    first = form((S["u"], S["u"]), (S["u"], S["v"]), (S["v"], S["v"]))
    second = form((S["uu"], normal), (S["uv"], normal), (S["vv"], normal))
    ascending = np.sort(np.linalg.eigvals(np.linalg.solve(first, second)).real, axis=1)
    return ascending[:, 1], ascending[:, 0]


def metric(name: str, fit: Fit, cloud: PointMap, config: SegmentationConfig) -> float:
    """One of the nine metrics of a fit (eq. 7-19), from its surface and the frame's points alone."""
    assert fit.surface is not None
    rows, columns = np.divmod(fit.pixels, cloud.valid.shape[1])
    if name in ("mse", "mae", "ve", "nle"):
        on_surface = derivatives(fit.surface, columns, rows)[""]
        errors = np.linalg.norm(on_surface - cloud.points_m[rows, columns], axis=1)
        return {
            "mse": lambda: np.mean(errors**2),
            "mae": lambda: np.mean(errors),
            "ve": lambda: np.var(errors),
            "nle": lambda: float(np.sum(errors > config.large_error_m)),
        }[name]()
    k1, k2 = principal_curvatures(fit.surface, columns, rows)
    largest = np.maximum(np.abs(k1), np.abs(k2))
    return {
        "vmxc": lambda: np.var(largest),
        "vmec": lambda: np.var((k1 + k2) / 2),
        "vgc": lambda: np.var(k1 * k2),
        "mmxc": lambda: np.mean(largest),
        "nlc": lambda: float(np.sum(largest > config.large_curvature_per_m)),
    }[name]()


def ratio(name: str, whole: tuple[float, int], *parts: tuple[float, int]) -> float:
    """Value after a split over that before it (eq. 5): counts add up, the others are weighed by points."""
    if name in ("nle", "nlc"):
        return sum(value for value, _ in parts) / whole[0]
    points = sum(count for _, count in parts)
    assert points == whole[1]
    return float(np.average([value for value, _ in parts], weights=[count for _, count in parts]) / whole[0])
