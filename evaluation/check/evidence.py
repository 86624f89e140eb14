"""Checks the evidence for merges against the image of the leaves, and against the limits of its terms."""

import math

import numpy as np

from nurbseg.evaluation.check.exported import ExportedContact, ExportedFrame
from nurbseg.segmentation.objects.evidence import BASE, GAP, TERMS

#: Smallest and largest value of features, as docs/default-method.md says.
_LIMITS = {"concave": (0.0, 1.0), "uneven": (0.0, 0.6), "apart": (0.0, 4.0), "enclosed": (0.0, 1.0)}
#: Evidence that a live tree adds for the state in the previous frame.
_KEPT = 1.5
#: Half of the last digit of a term.
_HALF = 5.1e-4

#: Smallest and largest value of each term.
_Bounds = dict[str, tuple[float, float]]


def check_evidence(frame: ExportedFrame) -> None:
    """Compare every term of evidence with its bounds.

    In a tree of one frame, the size of the larger surface and how much of its border encloses the smaller one
    follow from the image of the leaves. The crease between surfaces and their distance do not: they are those
    of surfaces fitted anew before the merges. In a live tree, all terms are averages over frames.
    """
    if not frame.objects:
        return
    # The numbers of a damaged file may be of any size.
    label_of = {leaf.name: leaf.leaf for leaf in frame.leaves if leaf.leaf and 0 < leaf.leaf < 1 << 16}
    on_grid = frame.leaf_image[:: frame.step, :: frame.step]
    sizes = np.bincount(on_grid.ravel(), minlength=1 << 16) * (frame.step * 640 / frame.shape[1]) ** 2
    lengths: dict[str, int] = {}
    for each in frame.tree.contacts:
        for name in (each.first, each.second):
            lengths[name] = lengths.get(name, 0) + (each.samples or 0)
    largest = math.log(frame.shape[0] * frame.shape[1] * (640 / frame.shape[1]) ** 2)
    for each in frame.tree.contacts:
        known = {each.first, each.second} <= label_of.keys()
        if each.evidence is None or not known:
            continue
        limits = _LIMITS | {"larger": (0.0, largest)}
        if frame.settings.independent:
            first, second = (float(sizes[label_of[name]]) for name in (each.first, each.second))
            small = each.second if first > second else each.first
            size = math.log(max(first, second, 1.0))
            enclosed = (each.samples or 0) / max(lengths[small], 1)
            limits |= {"larger": (size, size), "enclosed": (enclosed, enclosed)}
        _check_terms(frame, each, limits)


def _check_terms(frame: ExportedFrame, each: ExportedContact, limits: _Bounds) -> None:
    """Compare the terms of a contact with the limits of its features."""
    evidence = each.evidence or {}
    bounds: _Bounds = {"base": (BASE, BASE), "gap": (0.0, 0.0), "kept": (0.0, 0.0), "front": (-1e2, 1e2)}
    for term in TERMS:
        if term.name in limits:
            ends = [term.weight * (limit - term.neutral) for limit in limits[term.name]]
            bounds[term.name] = min(ends), max(ends)
    if not frame.settings.independent:
        # Averages over frames in some of which the surfaces do not touch.
        bounds = {name: (min(least, 0.0), max(most, 0.0)) for name, (least, most) in bounds.items()}
        bounds |= {"gap": (GAP, 0.0), "kept": (-_KEPT, _KEPT)}
    elif "gap" in evidence:
        bounds = dict.fromkeys(bounds, (0.0, 0.0)) | {"gap": (GAP, GAP)}
    for name in {**bounds, **evidence}:
        least, most = bounds.get(name, (0.0, 0.0))
        if not least - _HALF <= evidence.get(name, 0.0) <= most + _HALF:
            expected = f"{least:.3f}" if least == most else f"{least:.3f} to {most:.3f}"
            frame.wrong(f"{each.first}-{each.second}", f"evidence {name}", expected, evidence.get(name))
