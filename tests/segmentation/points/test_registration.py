import cv2
import numpy as np
import pytest

from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.common.lens import undistort
from nurbseg.segmentation.points.registration import PointMap, Registration, register
from scene.render import Renderer
from scene.source import SyntheticOptions, SyntheticSource

DISTORTION = (0.09, -0.2, 0.001, -0.002, 0.05)
#: OpenCV's fourteen coefficients, each of which moves some pixels by more than one.
STRONG = (0.3, -0.2, 0.04, -0.05, 0.2, 0.2, -0.25, 0.15, 0.1, -0.1, 0.08, 0.1, 0.05, -0.06)


def camera(width=64, height=48, focal=60.0, fy_sign=1, distortion=()):
    center = (width - 1) / 2 + 0.7, (height - 1) / 2 - 0.4
    return Intrinsics(width, height, focal, fy_sign * focal, *center, distortion=np.array(distortion))


def moved(x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0)):
    transform = np.eye(4)
    transform[:3, :3] = cv2.Rodrigues(np.array(turn))[0]
    transform[:3, 3] = x, y, z
    return transform


def ramp(width, height):
    """An image whose color tells its place: red grows along columns, green along rows."""
    v, u = np.mgrid[:height, :width]
    image = np.stack([40 + u * 150 / width, 40 + v * 150 / height, np.full_like(u, 90)], axis=-1)
    return np.rint(image).astype(np.uint8)


def hill(width=64, height=48):
    v, u = np.mgrid[:height, :width]
    depth = 1400 - 250 * np.exp(-((u - 30) ** 2 + (v - 20) ** 2) / 400)
    depth[::7, ::5] = 0
    return depth.astype(np.uint16)


def frame_of(calibration, depth_mm=None, color=None):
    """A frame of the hill and the ramp, or of other images."""
    depth_mm = hill() if depth_mm is None else depth_mm
    color = ramp(calibration.color.width, calibration.color.height) if color is None else color
    return RGBDFrame(0, 0, depth_mm, color, calibration)


def directly_projected(frame):
    """The definition, in double precision by OpenCV's own projection: place and depth in the color camera."""
    depth, color = frame.calibration.depth, frame.calibration.color
    v, u = np.mgrid[: depth.height, : depth.width]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    straight = (pixels - [depth.cx, depth.cy]) / [depth.fx, depth.fy]
    target = straight.copy()
    for _ in range(15 if depth.distortion.any() else 0):
        points = np.concatenate([straight, np.ones_like(straight[..., :1])], axis=-1)
        again = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), depth.distortion)[0]
        straight += target - again
    z = frame.depth_mm.reshape(-1, 1) / 1000
    points = np.concatenate([straight[:, 0] * z, z], axis=1)
    there = points @ frame.calibration.color_from_depth[:3, :3].T + frame.calibration.color_from_depth[:3, 3]
    places = cv2.projectPoints(there, np.zeros(3), np.zeros(3), color.matrix, color.distortion)[0]
    shape = frame.depth_mm.shape
    return points.reshape(*shape, 3), places.reshape(*shape, 2), there[:, 2].reshape(shape)


@pytest.mark.parametrize(
    ("depth_camera", "color_camera", "transform"),
    [
        (camera(), camera(focal=55), moved(x=-0.025)),
        (
            camera(distortion=DISTORTION),
            camera(focal=55, distortion=DISTORTION),
            moved(-0.02, 0.01, 0.02, (0.02, -0.01, 0.03)),
        ),
        (camera(fy_sign=-1), camera(fy_sign=-1, distortion=DISTORTION[:4]), moved(y=0.03)),
        (camera(), camera(1280, 1024, 1100.0, distortion=DISTORTION), moved(x=-0.025, turn=(0, 0.01, 0))),
        (camera(distortion=(*DISTORTION, 0.02, 0.01, -0.01)), camera(32, 24, 28.0), moved(turn=(0.05, 0, 0))),
        (camera(), camera(focal=55, distortion=STRONG[:8]), moved(x=-0.02)),
        (camera(), camera(focal=55, distortion=STRONG[:12]), moved(x=-0.02)),
        (camera(), camera(focal=55, distortion=STRONG), moved(x=-0.02)),
    ],
    ids=["offset", "bent", "upwards", "large color", "small color", "rational", "thin prism", "tilted"],
)
def test_points_and_colors_agree_with_a_direct_projection(depth_camera, color_camera, transform):
    frame = frame_of(Calibration(depth_camera, color_camera, transform))
    points, places, _ = directly_projected(frame)
    cloud = register(frame)
    has_depth = frame.depth_mm > 0
    assert np.array_equal(cloud.valid, has_depth)
    assert np.isnan(cloud.points_m[~has_depth]).all()
    np.testing.assert_allclose(cloud.points_m[has_depth], points[has_depth], atol=2e-5)
    size = np.array([color_camera.width, color_camera.height])
    inside = ((places > -0.5) & (places < size - 0.5)).all(axis=-1)
    assert inside.mean() > 0.6
    # The hill is smooth: whatever lies in the image is seen.
    assert np.array_equal(cloud.colored, has_depth & inside)
    # Beyond the centers of the outermost pixels are their colors.
    expected = 40 + np.clip(places[cloud.colored], 0, size - 1) * 150 / size
    np.testing.assert_allclose(cloud.color[cloud.colored][:, :2], expected, atol=1.2)


def step_frame(transform, gap=slice(24, 40)):
    """A red board before a blue wall, as both cameras see it."""
    depth = np.full((48, 64), 2000, dtype=np.uint16)
    depth[16:34, gap] = 800
    frame = frame_of(Calibration(camera(), camera(), transform), depth)
    _, places, _ = directly_projected(frame)
    board = places[16:34, gap]
    (left, top), (right, bottom) = board.min(axis=(0, 1)), board.max(axis=(0, 1))
    color = np.zeros((48, 64, 3), dtype=np.uint8)
    color[:] = 0, 0, 255
    color[round(top) : round(bottom) + 1, round(left) : round(right) + 1] = 255, 0, 0
    covered = (places > [left - 0.5, top - 0.5]) & (places < [right + 0.5, bottom + 0.5])
    hidden = covered.all(axis=-1) & (depth == 2000)
    return frame_of(frame.calibration, depth, color), hidden


@pytest.mark.parametrize("transform", [moved(x=-0.1), moved(x=0.1), moved(y=0.08), moved(-0.08, 0.08)])
def test_what_a_board_hides_does_not_take_the_boards_color(transform):
    frame, hidden = step_frame(transform)
    assert hidden.sum() > 30
    cloud = register(frame)
    border = cv2.dilate(hidden.astype(np.uint8), np.ones((3, 3))) - cv2.erode(
        hidden.astype(np.uint8), np.ones((3, 3))
    )
    inside_image = cloud.colored | hidden | (border > 0)
    assert not cloud.colored[hidden & (border == 0)].any()
    assert cloud.colored[inside_image & ~hidden & (border == 0)].all()
    wall, board = frame.depth_mm == 2000, frame.depth_mm == 800
    assert (cloud.color[hidden] == [0, 0, 255]).all()
    assert (cloud.color[wall & ~cloud.colored] == [0, 0, 255]).all()
    inner_board = cv2.erode(board.astype(np.uint8), np.ones((5, 5))) > 0
    assert (cloud.color[inner_board] == [255, 0, 0]).all()


def test_a_slit_between_two_boards_takes_the_color_behind_them():
    frame, _ = step_frame(moved(x=-0.1), gap=slice(20, 44))
    depth = frame.depth_mm.copy()
    depth[16:34, 31:33] = 2000
    cloud = register(frame_of(frame.calibration, depth, frame.color))
    slit = np.zeros(depth.shape, dtype=bool)
    slit[17:33, 31:33] = True
    assert not cloud.colored[slit].any()
    assert (cloud.color[slit] == [0, 0, 255]).all()


def test_pixels_without_depth_hide_nothing_from_a_color_camera_behind():
    frame = frame_of(Calibration(camera(), camera(focal=50), moved(x=0.01, z=0.05)))
    assert (frame.depth_mm == 0).any()
    cloud = register(frame)
    assert np.array_equal(cloud.colored, cloud.valid)


def test_points_outside_the_color_image_are_filled_from_their_own_surface():
    frame, _ = step_frame(moved(x=-0.7))
    cloud = register(frame)
    outside = cloud.valid & ~cloud.colored
    assert outside.any()
    assert (cloud.color[outside & (frame.depth_mm == 2000)] == [0, 0, 255]).all()


def test_registered_frames_pass_their_color_through():
    calibration = Calibration.registered(camera())
    frame = frame_of(calibration)
    cloud = register(frame)
    assert np.array_equal(cloud.color, frame.color)
    assert np.array_equal(cloud.colored, cloud.valid)
    row, col = 10, 12
    z = frame.depth_mm[row, col] / 1000
    expected = [(col - calibration.depth.cx) * z / 60, (row - calibration.depth.cy) * z / 60, z]
    np.testing.assert_allclose(cloud.points_m[row, col], expected, rtol=1e-6)


def test_a_camera_whose_image_runs_upwards_gives_points_with_y_downwards():
    points = register(frame_of(Calibration.registered(camera(fy_sign=-1)))).points_m
    assert np.nanmax(points[0, :, 1]) > 0 > np.nanmin(points[-1, :, 1])


@pytest.mark.parametrize("transform", [np.eye(4), moved(x=-0.025), moved(z=-50.0)])
def test_frames_without_any_visible_point_are_no_error(transform):
    depth = np.zeros((48, 64), dtype=np.uint16) if transform[2, 3] == 0 else hill()
    cloud = register(frame_of(Calibration(camera(), camera(focal=55), transform), depth))
    assert not cloud.colored.any()
    assert np.array_equal(cloud.valid, depth > 0)


def test_the_map_cannot_be_written_to():
    cloud = register(frame_of(Calibration.registered(camera())))
    for array in (cloud.points_m, cloud.color, cloud.colored, cloud.valid):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 0


@pytest.mark.parametrize(
    ("points", "color", "colored", "message"),
    [
        (np.zeros((4, 5, 3)), np.zeros((4, 5, 3), np.uint8), np.zeros((4, 5), bool), "points_m"),
        (np.zeros((4, 5, 3), np.float32), np.zeros((4, 5), np.uint8), np.zeros((4, 5), bool), "color"),
        (np.zeros((4, 5, 3), np.float32), np.zeros((4, 5, 3), np.uint8), np.zeros((5, 4), bool), "colored"),
    ],
)
def test_maps_of_unequal_shapes_are_refused(points, color, colored, message):
    with pytest.raises(ValueError, match=message):
        PointMap(points, color, colored)


@pytest.mark.parametrize("sensor", ["objects", "large color"])
def test_what_the_synthetic_color_camera_sees_is_what_is_colored(sensor):
    size = {"color_width": 1280, "color_height": 1024} if sensor == "large color" else {}
    options = SyntheticOptions(noise=False, offset=True, distortion=True, **size)
    with SyntheticSource(options) as source:
        source.seek(20)
        frame = source.read()
        color_from_depth = frame.calibration.color_from_depth
        world_from_color = source.poses(20)[0] @ np.linalg.inv(color_from_depth)
        seen = Renderer(source._scene, frame.calibration.color).render(world_from_color, 20)
    _, places, depth = directly_projected(frame)
    nearest = np.rint(places).astype(int)
    height, width = seen.depth_m.shape
    inside = ((nearest >= 0) & (nearest < [width, height])).all(axis=-1)
    columns, rows = (np.clip(nearest[..., i], 0, n - 1) for i, n in ((0, width), (1, height)))
    truth = inside & (np.abs(seen.depth_m[rows, columns] - depth) < 0.012)
    cloud = register(frame)
    # At outlines a pixel's center decides: judge a pixel away from them.
    truth_bytes = truth.astype(np.uint8)
    clear = cv2.dilate(truth_bytes, np.ones((3, 3))) == cv2.erode(truth_bytes, np.ones((3, 3)))
    assert (~truth & clear & inside).sum() > 100
    assert not (cloud.colored & ~truth & clear).any()
    # Seen, but not colored: only where something nearer is within the reach of the sampling.
    nearness = 1 / frame.depth_mm.astype(np.float32)
    outlines = cv2.dilate(nearness, np.ones((5, 5))) / cv2.erode(nearness, np.ones((5, 5))) > 1.04
    outlines |= cv2.dilate(1 - truth_bytes, np.ones((5, 5))) > 0
    assert (truth & ~cloud.colored & ~outlines).sum() < 50
    assert (cloud.colored == truth).mean() > 0.99
    labels = seen.objects[rows, columns]
    assert (labels == frame.labels)[cloud.colored].mean() > 0.995


def some_lens(count, rng):
    scale = np.array([0.1, 0.1, 0.002, 0.002, 0.03, 0.02, 0.02, 0.01, 0.002, 0.002, 0.002, 0.002, 0.02, 0.02])
    return (rng.uniform(-1, 1, 14) * scale)[:count]


def distorted(points, distortion):
    rays = np.column_stack([points, np.ones(len(points))])
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), distortion)[0].reshape(-1, 2)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_what_a_lens_distorts_is_undistorted(count):
    rng = np.random.default_rng(count)
    distortion, points = some_lens(count, rng), rng.uniform(-0.6, 0.6, (200, 2))
    again = undistort(distorted(points, distortion), distortion, 1e-10)
    np.testing.assert_allclose(again, points, atol=1e-8)


@pytest.mark.parametrize(
    ("distortion", "shown", "beyond"),
    [
        ((-0.05, 0.24, 0.0, 0.0, -1.0), 0.3, (0.72, 0.8)),
        # OpenCV finds a point for this place, but beyond the fold.
        ((-0.5, 0.1, 0.0, 0.0, 0.0), 0.3, (0.785, 0.795)),
    ],
)
def test_what_a_folding_lens_cannot_show_has_no_ray(distortion, shown, beyond):
    places = np.array([[shown, 0.0], *([x, 0.0] for x in beyond)])
    x, _ = undistort(places, np.array(distortion), 1e-7).T
    assert np.isfinite(x).tolist() == [True, False, False]


def test_nothing_from_beyond_a_lens_fold_appears_inside_the_image():
    # The depth camera sees far beyond it.
    folding = camera(focal=40, distortion=(-0.05, 0.24, 0.0, 0.0, -1.0))
    flat = np.full((48, 64), 1000, np.uint16)
    cloud = register(frame_of(Calibration(camera(focal=12), folding, moved()), flat))
    radius = np.linalg.norm(cloud.points_m[..., :2] / cloud.points_m[..., 2:], axis=-1)
    assert cloud.colored[radius < 0.5].all()
    assert not cloud.colored[radius > 0.8].any()


def real_pair(folder):
    stored = cv2.FileStorage(str(folder / "calib_params.xml"), cv2.FILE_STORAGE_READ)
    cameras = []
    for name in ("IR", "RGB"):
        matrix = stored.getNode(f"{name}_intrinsic_params").mat()
        distortion = stored.getNode(f"{name}_distortion_coefficients").mat().ravel()
        cameras.append(
            Intrinsics(
                640, 480, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], distortion=distortion
            )
        )
    transform = np.eye(4)
    transform[:3, :3] = stored.getNode("Rotation").mat()
    transform[:3, 3] = stored.getNode("Translation").mat().ravel() / 1000
    depth = cv2.imread(str(folder / "depth_0.png"), cv2.IMREAD_UNCHANGED)
    color = cv2.cvtColor(cv2.imread(str(folder / "rgb_0.png")), cv2.COLOR_BGR2RGB)
    return frame_of(Calibration(*cameras, transform), depth, color)


def test_on_a_real_pair_the_floors_crease_lies_on_its_color_edge(real_data):
    frame = real_pair(real_data("cape_calibrated_pair"))
    offsets = []
    for transform in (frame.calibration.color_from_depth, np.linalg.inv(frame.calibration.color_from_depth)):
        calibration = Calibration(frame.calibration.depth, frame.calibration.color, transform)
        cloud = register(frame_of(calibration, frame.depth_mm, frame.color))
        smooth = cv2.blur(np.nan_to_num(cloud.points_m), (9, 9))
        across, down = (np.roll(smooth, -6, axis) - np.roll(smooth, 6, axis) for axis in (1, 0))
        normal = np.cross(across, down)
        normal /= np.linalg.norm(normal, axis=2, keepdims=True) + 1e-9
        bend = ((np.roll(normal, -7, 1) - np.roll(normal, 7, 1)) ** 2).sum(axis=2)
        gray = cv2.GaussianBlur(cv2.cvtColor(cloud.color, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.5)
        rows = range(330, 455, 3)
        creases = [300 + int(np.argmax(bend[row, 300:460])) for row in rows]
        profile = np.mean([gray[row, c - 20 : c + 21] for row, c in zip(rows, creases, strict=True)], axis=0)
        offsets.append(abs(int(np.argmax(np.diff(profile))) - 19.5))
    assert offsets[0] <= 3
    # The transform the other way round puts it elsewhere: the measure tells them apart.
    assert offsets[1] > 10


def test_what_depends_on_the_calibration_is_prepared_once_for_all_that_are_equal(monkeypatch):
    def frame(focal, x=0.02, distortion=DISTORTION):
        cameras = camera(focal=focal), camera(distortion=distortion)
        return frame_of(Calibration(*cameras, moved(x=x)))

    frames = [frame(60.0), frame(60.0), frame(61.0), frame(61.0, x=0.03), frame(61.0, 0.03, ()), frame(60.0)]
    prepared, rays = [], Intrinsics.rays
    monkeypatch.setattr(Intrinsics, "rays", lambda depth: prepared.append(depth) or rays(depth))
    once = Registration()
    found = [once.register(frame) for frame in frames]
    assert [id(each) for each in prepared] == [id(frames[n].calibration.depth) for n in (0, 2, 3, 4, 5)]
    for cloud, frame in zip(found, frames, strict=True):
        alone = register(frame)
        assert np.array_equal(cloud.points_m, alone.points_m, equal_nan=True)
        assert np.array_equal(cloud.color, alone.color)
        assert np.array_equal(cloud.colored, alone.colored)
