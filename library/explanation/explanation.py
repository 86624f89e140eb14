"""Why a frame was segmented as it was, step by step, as values, pictures and one HTML page."""

from dataclasses import dataclass, replace
from pathlib import Path

from nurbseg.common.files import write_atomically
from nurbseg.library.explanation.page import framed, page
from nurbseg.library.explanation.panels import Panels, panels
from nurbseg.library.explanation.picture import picture
from nurbseg.library.explanation.steps import Step, steps_of
from nurbseg.library.notebook import show
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.judged import JudgedSplit
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.grid import grid_step
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.vocabulary import display_name


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Explanation:
    """The recursion of one frame.

    Parameters
    ----------
    title : str
        What was segmented, and how.
    cloud : PointMap
        The frame's points.
    tree : SegmentationTree
        Its segments.
    steps : tuple of Step
        Every split that decided, kept or rejected, and every object of several surfaces.
    grid_step : int
        Distance of the rows and columns of the grid on which splits are decided, pixels.
    """

    title: str
    cloud: PointMap
    tree: SegmentationTree
    steps: tuple[Step, ...]
    grid_step: int

    def __repr__(self) -> str:
        return f"Explanation({self.title}: {len(self.steps)} steps)"

    def panels(self, step: Step) -> Panels:
        """Return the pictures of a step as arrays."""
        return panels(step, self.cloud.color, self.grid_step)

    def picture(self, step: Step) -> str:
        """Return a step as one picture: SVG, which needs no other file."""
        return picture(step, self.panels(step), self.tree, self.steps, self.title)

    def html(self) -> str:
        """Return a page of all steps, which needs no other file or host; arrow keys go through them."""
        return page(self.title, [self.picture(step) for step in self.steps])

    def save(self, folder: str | Path) -> Path:
        """Write the page and the picture of each step; return the page.

        Parameters
        ----------
        folder : str or Path
            Made, for its user only, if it is missing. Files of the same names are replaced.

        Raises
        ------
        OSError
            If a file cannot be written.
        """
        folder = Path(folder)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        pictures = [self.picture(step) for step in self.steps]
        for step, drawn in zip(self.steps, pictures, strict=True):
            name = f"{step.number:03d}-{step.kind}-{display_name(step.name)}.svg"
            write_atomically(folder / name, drawn.encode())
        path = folder / "index.html"
        write_atomically(path, page(self.title, pictures).encode())
        return path

    def show(self) -> None:
        """Show the page in a notebook, also within a loop; raises RuntimeError where there is none."""
        show(self, "save(folder) writes a page for any browser")

    def _repr_html_(self) -> str:
        """Return the page for a notebook, within a frame of its own."""
        return framed(self.html())


def explained(cloud: PointMap, config: SegmentationConfig, name: str) -> Explanation:
    """Segment a frame by itself, and explain each decision.

    Parameters
    ----------
    cloud : PointMap
        The frame.
    config : SegmentationConfig
        The settings; the time limit does not apply.
    name : str
        Of the frame, for the title.

    Returns
    -------
    Explanation
        The tree is the same as without an explanation.
    """
    judged: list[JudgedSplit] = []
    config = replace(config, budget_ms=0)
    tree = segment(cloud, config, observe=judged.append)
    metric = config.metric.upper()
    title = f"{name}, method {config.method}, metric {metric}, T = {config.ratio_max:g}"
    step = grid_step(cloud.valid, config.decimation)
    return Explanation(title, cloud, tree, steps_of(tree, judged, config), step)
