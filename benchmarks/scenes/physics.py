"""Things fall until they lie still."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pybullet
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from shapes import Solid, thing

#: Steps per second, steps that each thing has before the next one falls, and those of all at the end.
_RATE, _STEPS, _STEPS_LAST = 200, 80, 400


#: Where a thing falls: x and y, the height of what it falls on at least, and its size relative to usual.
Spot = tuple[float, float, float, float]


def _body(solid: Solid, mass: float, friction: float, file: Path) -> int:
    """Add a solid of convex parts; without mass it does not move."""
    lines, count = [], 1
    for number, part in enumerate(solid.parts):
        hull = ConvexHull(part)
        lines.append(f"o {number}")
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in part[hull.vertices]]
        place = np.zeros(len(part), dtype=np.intp)
        place[hull.vertices] = count + np.arange(len(hull.vertices))
        lines += [f"f {a} {b} {c}" for a, b, c in place[hull.simplices]]
        count += len(hull.vertices)
    file.write_text("\n".join(lines) + "\n")
    shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, fileName=str(file))
    body = pybullet.createMultiBody(mass, shape, basePosition=(0.0, 0.0, 50.0 if mass else 0.0))
    # Things have some drag, or they roll for long.
    pybullet.changeDynamics(
        body, -1, lateralFriction=friction, rollingFriction=0.002, spinningFriction=0.002, angularDamping=0.15
    )
    return int(body)


def settle(rng: np.random.Generator, fixed: Sequence[Solid], spots: Sequence[Spot]) -> list[Solid]:
    """Let a thing fall at each spot, one after the other, and return those that stay up, where they lie.

    Parameters
    ----------
    rng : Generator
        Draws the things and how they fall.
    fixed : sequence of Solid
        What they fall on.
    spots : sequence of Spot
        Where they fall.
    """
    client = pybullet.connect(pybullet.DIRECT)
    try:
        pybullet.setGravity(0, 0, -9.81)
        pybullet.setPhysicsEngineParameter(
            numSolverIterations=60, deterministicOverlappingPairs=1, fixedTimeStep=1 / _RATE
        )
        with tempfile.TemporaryDirectory() as folder:
            for number, solid in enumerate(fixed):
                _body(solid, 0.0, 0.7, Path(folder) / f"fixed{number}.obj")
            fallen = [_drop(rng, spot, Path(folder) / f"{number}.obj") for number, spot in enumerate(spots)]
        for step in range(_STEPS_LAST):
            if step % 50 == 0:
                damping = 0.1 + 0.8 * step / _STEPS_LAST
                for _, body in fallen:
                    pybullet.changeDynamics(body, -1, linearDamping=damping, angularDamping=damping)
            pybullet.stepSimulation()
        lying = []
        for (solid, body), (_, _, least, _) in zip(fallen, spots, strict=True):
            position, turn = pybullet.getBasePositionAndOrientation(body)
            placed = solid.placed(position, Rotation.from_quat(turn).as_matrix())
            if placed.vertices[:, 2].min() > least - 0.02:
                lying.append(placed)
        return lying
    finally:
        pybullet.disconnect(client)


def _drop(rng: np.random.Generator, spot: Spot, file: Path) -> tuple[Solid, int]:
    """Let a thing fall from just above what is there; its center of mass becomes its origin."""
    x, y, least, scale = spot
    solid, lies = thing(rng)
    solid = solid.placed(turn=scale * np.eye(3))
    volumes = [np.prod(np.ptp(part, axis=0)) for part in solid.parts]
    solid = solid.placed(-np.average([part.mean(0) for part in solid.parts], axis=0, weights=volumes))
    way = rng.random() - 0.3 * lies
    tilt = Rotation.identity()
    if way > 0.5:
        tilt = (
            Rotation.from_euler("x", 90.0, degrees=True) if way < 0.8 else Rotation.random(random_state=rng)
        )
    turn = Rotation.from_euler("z", rng.uniform(0.0, 360.0), degrees=True) * tilt
    points = turn.apply(solid.vertices)
    body = _body(solid, float(np.clip(400.0 * sum(volumes), 0.03, 1.0)), rng.uniform(0.4, 0.8), file)
    reach = float(np.hypot(points[:, 0], points[:, 1]).max())
    steps = np.linspace(-reach, reach, 9)
    over = np.stack(np.meshgrid(x + steps, y + steps, 3.0), axis=-1).reshape(-1, 3)
    under = over * [1.0, 1.0, 0.0] + [0.0, 0.0, least]
    top = max([least, *(hit[3][2] for hit in pybullet.rayTestBatch(over, under) if hit[0] >= 0)])
    height = top + 0.008 - points[:, 2].min()
    pybullet.resetBasePositionAndOrientation(body, (x, y, height), turn.as_quat())
    for _ in range(_STEPS):
        pybullet.stepSimulation()
    return solid, body
