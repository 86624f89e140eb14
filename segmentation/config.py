"""The settings of the segmentation; every quantity that the paper leaves open is one of them.

Each field carries what a person needs to set it (text, unit, bounds), so that the command line,
the configuration file and the checks are made from this one place. The section says who reads it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from nurbseg.common.settings import Settings, setting

Method = Literal["stag15", "nurbseg"]
Metric = Literal["mse", "mae", "ve", "nle", "vmxc", "vmec", "vgc", "mmxc", "nlc"]
SplittingPoint = Literal["zero", "kmeans", "ncut"]
Up = Literal["auto", "top", "bottom", "left", "right"]
Level = Literal["surfaces", "objects"]
ControlPoints = Literal["adaptive", "fixed"]
LeastSquares = Literal["auto", "svd", "ridge"]
DepthSmoothing = Literal["none", "median", "bilateral"]

#: Units of the metrics; those in points are counts, the others are means and variances.
METRIC_UNITS: Mapping[Metric, str] = {
    "mse": "m²",
    "mae": "m",
    "ve": "m²",
    "nle": "points",
    "vmxc": "1/m²",
    "vmec": "1/m²",
    "vgc": "1/m⁴",
    "mmxc": "1/m",
    "nlc": "points",
}
#: Settings in pixels are for images of this width, or of so many pixels; they are scaled for others.
REFERENCE_WIDTH, REFERENCE_PIXELS = 640, 640 * 480
#: A surface or plane explains a point that lies within so many standard deviations of it.
OUTLIER_DEVIATIONS = 4.0
#: Leaves of the live tree that are tried in one frame, unless that is set.
TRIALS_MAX = 8


@dataclass(frozen=True, slots=True)
class DepthConfig(Settings):
    """What is done to a depth image before it becomes points, in this order; nothing unless it is asked for.

    Raises
    ------
    ValueError
        If a value is out of its bounds, or the range or the crop is empty.
    """

    range_min_m: float = setting(
        0.0, "discard depth below this", unit="m", least=0.0, most=65.0, flag="range-min"
    )
    range_max_m: float = setting(
        0.0, "discard depth above this; 0 for no limit", unit="m", least=0.0, most=65.0, flag="range-max"
    )
    crop: tuple[int, int, int, int] | None = setting(
        None, "the part of the depth image to keep, in pixels", unit="LEFT,TOP,WIDTH,HEIGHT"
    )
    smoothing: DepthSmoothing = setting(
        "none",
        "filter of 5x5 pixels: their median, or their mean weighted by closeness in inverse depth",
        flag="depth-smoothing",
    )
    average_frames: int = setting(
        1,
        "for a stationary camera: frames over which to average each pixel's depth while it stays within "
        "the noise",
        least=1,
        most=100,
        flag="depth-average",
    )
    holes_px: int = setting(
        0,
        "fill pixels without depth from the nearest pixel with depth, at most this far away",
        unit="px",
        least=0,
        most=1000,
        flag="fill-holes",
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if 0.0 < self.range_max_m <= self.range_min_m:
            raise ValueError(
                f"range_max_m: expected more than range_min_m ({self.range_min_m}), got {self.range_max_m}"
            )
        if self.crop is not None and (min(self.crop[:2]) < 0 or min(self.crop[2:]) < 1):
            raise ValueError(f"crop: expected left, top, width and height in pixels, got {self.crop}")

    def check_crop(self, width: int, height: int) -> None:
        """Raise ValueError if the crop keeps nothing of a depth image of so many pixels."""
        if self.crop is not None and (self.crop[0] >= width or self.crop[1] >= height):
            raise ValueError(f"crop: {self.crop} is outside of a depth image of {width}x{height}")


@dataclass(frozen=True, slots=True)
class Stag15Config(Settings):
    """Settings that only the paper's method reads."""

    segment_pixels_min: int = setting(
        1500,
        "T_p, the minimum segment size, in pixels of a 640x480 image (scaled with the image)",
        unit="px",
        least=1,
    )
    control_points_max: int = setting(
        20, "control points per direction for a segment that spans the image", least=4, most=200
    )
    control_points: ControlPoints = setting(
        "adaptive",
        "whether smaller segments get fewer control points, or all the same number (Pagnutti 2014)",
    )
    least_squares: LeastSquares = setting(
        "auto",
        "least-squares solver: svd gives the minimum-norm solution, as in the paper; ridge is faster and "
        "regularizes weakly determined directions; auto is svd if a curvature metric decides, else ridge",
    )


@dataclass(frozen=True, slots=True)
class ExtendedConfig(Settings):
    """Settings that only the default method reads, for frames alone and for the live tree."""

    level: Level = setting(
        "objects", "what a label stands for: a surface (leaf of the tree) or an object (merged leaves)"
    )
    inverse_depth_noise: float = setting(
        2.2e-3, "sensor noise, the standard deviation of inverse depth", unit="1/m", above=0.0, most=1.0
    )
    noise_floor: float = setting(
        1.0,
        "in the ratio (eq. 5) a metric counts as at least its value under noise of this many times "
        "inverse_depth_noise; 0 for the ratio alone",
        least=0.0,
    )
    noise_correlation_px: float = setting(
        30.0,
        "side of the square within which sensor noise is correlated, in pixels of a 640-wide image; 1 for "
        "white noise. Surfaces follow such noise, which raises the floors of curvature metrics",
        unit="px",
        least=1.0,
        most=640.0,
    )
    inverse_depth_gap: float = setting(
        0.025,
        "minimum step in inverse depth between neighbors, or between surfaces extended to their common "
        "border, that counts as a gap",
        unit="1/m",
        above=0.0,
    )
    piece_pixels_min: int = setting(
        120, "T_p, the minimum segment size, in pixels of a 640x480 image", unit="px", least=1
    )
    cuts: int = setting(
        3,
        "eigenvectors to try, from the second on, until one gives a split; one more, unless this is 1, "
        "for a segment whose error is far above noise",
        least=1,
        most=10,
    )
    color_weight: float = setting(0.25, "weight of color in the vectors", least=0.0)
    normal_weight: float = setting(1.0, "weight of surface normals in the vectors; 0 for none", least=0.0)
    normal_window_px: int = setting(
        17, "window size for normals, in pixels of a 640-wide image", unit="px", least=3, most=640
    )
    knot_spacing_px: float = setting(
        40.0, "knot spacing of a surface, in pixels of a 640-wide image", unit="px", least=8.0
    )
    smoothness: float = setting(
        0.1,
        "weight of the squared second differences of a surface's control values, relative to the squared "
        "residuals at every second row and column",
        least=0.0,
    )
    fold_surfaces: bool = setting(
        True, "whether to merge surfaces that meet smoothly and that one surface explains as well"
    )
    split_creases: bool = setting(
        True,
        "whether to split a large surface where planes meet in a crease of at least 20 degrees that it "
        "follows within noise",
    )
    protrusion_min: float = setting(
        2.5,
        "points nearer than a surface by more than this many times inverse_depth_noise, or the root mean "
        "square of its residuals if that is larger, become a surface of their own if they are connected, at "
        "least piece_pixels_min in number and contain a square of 8 pixels; 0 for never",
        least=0.0,
    )
    refine_borders: bool = setting(
        True, "whether to assign border pixels to the surface that explains them best"
    )
    merge_surfaces: bool = setting(True, "whether to merge surfaces into objects")
    log_odds_min: float = setting(
        0.0,
        "merge surfaces whose log odds of being one object exceed this: above 0 for fewer merges, below "
        "for more",
    )
    up: Up = setting(
        "auto",
        "side of the image towards which up is, for the boxes of objects where the source does not measure "
        "gravity; auto: the top, and boxes are not sure where a plane faces another side more",
    )


@dataclass(frozen=True, slots=True)
class SegmentationConfig(Settings):
    """Settings of the recursive segmentation; symbols are the paper's.

    What both methods read is here; `stag15` (a `Stag15Config`) and `extended` (an `ExtendedConfig`, both of
    `nurbseg.segmentation.config`) hold what one of them reads.
    """

    method: Method = setting(
        "nurbseg",
        "segmentation method: the paper's (stag15), or the extended one, which merges surfaces into "
        "objects (nurbseg)",
    )
    metric: Metric = setting("mse", "surface fit metric that decides a split (eq. 7-22)")
    ratio_max: float = setting(
        1.0, "T: a split is kept if its metric ratio is below this (eq. 5)", above=0.0, symbol="threshold"
    )
    geometry_weight: float = setting(
        1.0, "lambda: weight of position against color (eq. 3)", least=0.0, symbol="lambda"
    )
    samples: int = setting(
        100, "points drawn at random whose affinities are computed exactly (Nystrom)", least=2, most=2000
    )
    landmarks: int = setting(
        60, "samples that are used, those that best explain the affinities of the others", least=2, most=2000
    )
    cut_points: int = setting(
        6000, "points of a segment used to compute its cut; the others are classified by extension", least=100
    )
    affinity_scale: float = setting(
        0.7, "sigma of the Gaussian affinity, in normalized vector units", least=1e-3, most=1e3
    )
    splitting_point: SplittingPoint = setting(
        "zero", "where the second eigenvector is cut: at zero, by 2-means, or where Ncut is least"
    )
    depth_max: int = setting(8, "T_d: maximum depth of the tree", least=0, most=64)
    splits_max: int = setting(60, "T_s: maximum number of splits", least=0, most=10_000)
    budget_ms: float = setting(
        0.0,
        "time limit for cuts, from the start of a frame's segmentation, after which the tree so far is "
        "the result; 0 for no limit",
        unit="ms",
        least=0.0,
    )
    large_error_m: float = setting(
        0.1, "T_l: residual above which a point counts for NLE", unit="m", above=0.0
    )
    large_curvature_per_m: float = setting(
        10.0, "T_c: curvature above which a point counts for NLC", unit="1/m", above=0.0
    )
    decimation: int = setting(
        0,
        "pixel step of the grid on which splits are decided; 0 for 1 in images of up to 320 columns, and in "
        "larger ones 2 or what gives the grid about 320. Borders are refined on every pixel",
        least=0,
        most=8,
    )
    seed: int = setting(0, "seed of the random sample; the same seed gives the same tree", least=0)
    stag15: Stag15Config = field(default_factory=Stag15Config)
    extended: ExtendedConfig = field(default_factory=ExtendedConfig)
