import numpy as np
import pytest

from scene.shapes import bowl, box, cushion, cylinder, ellipsoid, rectangle, surface

CUSHION = cushion(0.15, 0.12, 0.06)


def box_gap(p):
    """Largest of the six distances: negative inside, 0 on the surface."""
    return np.max(np.abs(p) - [0.2, 0.1, 0.15], axis=-1)


def cylinder_gap(p):
    side = np.hypot(p[..., 0], p[..., 1]) - 0.1
    return np.maximum(side, np.maximum(p[..., 2] - 0.25, -p[..., 2]))


def ellipsoid_gap(p):
    return np.linalg.norm(p / [0.1, 0.15, 0.2], axis=-1) - 1


SOLIDS = [
    (box(0.2, 0.1, 0.15), box_gap),
    (cylinder(0.1, 0.25), cylinder_gap),
    (ellipsoid(0.1, 0.15, 0.2), ellipsoid_gap),
]
IDS = ["box", "cylinder", "ellipsoid", "bowl", "cushion", "rectangle"]
SHAPES = [shape for shape, _ in SOLIDS] + [bowl(0.2, 0.12), CUSHION, rectangle(0.3, 0.2)]


def rays(count=3000, seed=0):
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=(3, count))
    origin *= 0.8 / np.linalg.norm(origin, axis=0)
    origin[2] = np.abs(origin[2])
    target = rng.uniform(-0.2, 0.2, (3, count))
    direction = target - origin
    return origin.T.astype(np.float32), direction.T.astype(np.float32)


def points(origin, t, direction):
    return origin + t[:, None] * direction


def cushion_height(x, y):
    """Height of `CUSHION`: a bump that is flat at its rim, with folds."""
    x, y = x / 0.15, y / 0.12
    return 0.06 * (1 - x**2) * (1 - y**2) * (1 + 0.25 * np.sin(2.5 * (x + 0.6 * y) + 0.7))


@pytest.mark.parametrize(("shape", "gap"), SOLIDS, ids=["box", "cylinder", "ellipsoid"])
def test_rays_meet_solids_first_where_a_fine_walk_along_them_does(shape, gap):
    origin, direction = rays()
    t, _ = shape.hit(origin, direction)
    steps = np.linspace(0, 2, 2001)
    inside = gap(origin[:, None] + steps[:, None] * direction[:, None]) <= 0
    walked = np.where(inside.any(axis=1), steps[np.argmax(inside, axis=1)], np.inf)
    met = np.isfinite(t)
    assert 0.2 < met.mean() < 0.95
    # A walk with finite steps may miss a corner that a ray only grazes.
    assert (np.isfinite(walked) & ~met).sum() == 0
    assert (met & ~np.isfinite(walked)).mean() < 0.005
    both = met & np.isfinite(walked)
    assert (np.abs(t[both] - walked[both]) <= 1.01e-3).mean() > 0.995
    np.testing.assert_allclose(gap(points(origin[met], t[met], direction[met])), 0, atol=1e-5)


def test_rays_meet_the_bowl_outside_or_inside():
    half_sphere = bowl(0.2, 0.12)
    origin, direction = rays()
    t, face = half_sphere.hit(origin, direction)
    met = np.isfinite(t)
    point = points(origin[met], t[met], direction[met])
    np.testing.assert_allclose(np.linalg.norm(point - [0, 0, 0.2], axis=1), 0.2, atol=2e-6)
    assert (point[:, 2] <= 0.12 + 1e-6).all()
    assert {0, 1} == set(np.unique(face[met]))
    # Straight from above one sees the inside, from below the outside.
    up = np.array([[0, 0, 1]], dtype=np.float32)
    assert half_sphere.hit(up, -up)[1] == 1
    assert half_sphere.hit(-up, up)[1] == 0


def test_rays_meet_the_cushion_on_its_surface():
    origin, direction = rays()
    t, _ = CUSHION.hit(origin, direction)
    met = np.isfinite(t)
    assert met.mean() > 0.2
    x, y, z = points(origin[met], t[met], direction[met]).T
    np.testing.assert_allclose(z, cushion_height(x, y), atol=5e-5)


def what_is_met(shape, seed):
    """Return points and faces that rays meet, and these rays' origins and directions."""
    origin, direction = rays(seed=seed)
    t, face = shape.hit(origin, direction)
    met = np.isfinite(t)
    return points(origin[met], t[met], direction[met]), face[met], origin[met], direction[met]


@pytest.mark.parametrize("shape", SHAPES, ids=IDS)
def test_normals_are_units_and_stand_across_the_surface(shape):
    point, face, origin, direction = what_is_met(shape, seed=3)
    # One by one, as the loops of the renderer do.
    found = np.array([surface(shape.kind, shape.sizes, *p, f) for p, f in zip(point, face, strict=True)])
    normal, places = found[:, :3], found[:, 3:]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-4)
    assert places.min() >= -1e-3 and places.max() <= 1 + 1e-3
    # A neighboring ray meets the same face at a point that lies in the tangent plane.
    nudged = direction + np.array([1e-3, 2e-3, -1e-3], dtype=np.float32)
    t, other = shape.hit(origin, nudged)
    beside = points(origin, np.where(np.isfinite(t), t, 0), nudged)
    same = np.isfinite(t) & (other == face)
    step = (beside - point)[same]
    slope = np.abs((step * normal[same]).sum(axis=1)) / np.linalg.norm(step, axis=1)
    assert np.median(slope) < 0.02


@pytest.mark.parametrize("shape", SHAPES, ids=IDS)
def test_nothing_reaches_out_of_the_stated_box(shape):
    point = what_is_met(shape, seed=5)[0]
    low, high = shape.corners_m.min(axis=0), shape.corners_m.max(axis=0)
    assert (low - 1e-5 <= point).all() and (high + 1e-5 >= point).all()
