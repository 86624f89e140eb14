"""The tree of a frame as JSON or DOT, and its surfaces as an NPZ file."""

import io
import math
from dataclasses import fields
from typing import Any

import numpy as np

from nurbseg.library.result import FrameResult
from nurbseg.segmentation.config import Metric
from nurbseg.segmentation.objects.merge import Contact, Merge
from nurbseg.segmentation.segments import Segment, SegmentationTree, Trial
from nurbseg.segmentation.vocabulary import display_name


def tree_document(result: FrameResult, metric: Metric) -> dict[str, Any]:
    """Return a frame's tree, decided by `metric`, as the content of its JSON file."""
    tree = result.tree
    numbered = tuple(zip(result.object_labels, tree.objects, strict=True))
    object_of = {name: label for label, each in numbered for name in each.leaves}
    leaf_of = {leaf.name: label for label, leaf in zip(result.surface_labels, tree.leaves(), strict=True)}
    label_of = object_of if tree.objects and tree.level != "surfaces" else leaf_of
    return {
        "frame": result.frame.index,
        "name": result.frame.name,
        "timestamp_ns": result.frame.timestamp_ns,
        "height": tree.shape[0],
        "width": tree.shape[1],
        "metric": metric,
        "level": tree.level,
        "segments": [
            {
                **_segment_document(segment, metric, result.frame.index),
                "label": label_of.get(segment.name),
                "leaf": leaf_of.get(segment.name),
                "object": object_of.get(segment.name),
            }
            for segment in tree.segments
        ],
        "objects": [
            {"object": label, "leaves": [display_name(name) for name in each.leaves]}
            for label, each in numbered
        ],
        "events": [
            {"kind": event.kind, "label": event.identity, "other": event.other} for event in result.events
        ],
        "contacts": [
            {**_pair_document(contact, left_out=("touching", "log_odds_min")), "reason": contact.reason}
            for contact in tree.contacts
        ],
        "merges": [_pair_document(merge) for merge in tree.merges],
    }


def _pair_document(pair: Contact | Merge, left_out: tuple[str, ...] = ()) -> dict[str, Any]:
    found = {name: value for name, value in _by_field(pair).items() if name not in left_out}
    return {**found, "first": display_name(pair.first), "second": display_name(pair.second)}


def _by_field(each: Contact | Merge | Trial) -> dict[str, Any]:
    # `asdict` also copies what the fields hold, which takes 2 % of a frame's time.
    return {field.name: getattr(each, field.name) for field in fields(each)}


def _segment_document(each: Segment, metric: Metric, frame: int) -> dict[str, Any]:
    return {
        "name": display_name(each.name),
        "parent": None if each.parent is None else display_name(each.parent),
        "children": [display_name(child) for child in each.children],
        "size": int(each.pixels.size),
        "depth": each.depth,
        "cuts_above": each.cuts_above,
        "measured": None if not each.fit.values else frame if each.measured is None else each.measured,
        "judged": frame if each.judged is None else each.judged,
        "value": _number(each.fit.values.get(metric, math.nan)),
        "floor": _number(each.fit.floor),
        "values": {name: _number(value) for name, value in each.fit.values.items()},
        "ratio": None if each.ratio is None else _number(each.ratio),
        "trial": each.trial and _trial_document(each.trial),
        "division": None if each.division is None else each.division.value,
        "stop": None if each.stop is None else each.stop.value,
        "points": int(each.fit.pixels.size),
        "surface": each.fit.surface is not None,
        "reason": each.fit.reason,
    }


def _trial_document(trial: Trial) -> dict[str, Any]:
    parts = [{"value": _number(value), "points": points} for value, points in trial.parts]
    return {**_by_field(trial), "value": _number(trial.value), "parts": parts}


def _number(value: float) -> float | None:
    # JSON has neither infinity nor NaN.
    return float(value) if math.isfinite(value) else None


def tree_graph(result: FrameResult, metric: Metric) -> str:
    """Return a frame's tree in Graphviz's language DOT."""
    lines = [f'digraph "frame {result.frame.index}" {{', '  node [shape=box, fontname="sans-serif"];']
    object_of = dict(
        zip((leaf.name for leaf in result.tree.leaves()), result.object_of_leaf[1:], strict=True)
    )
    for segment in result.tree.segments:
        name, value = display_name(segment.name), segment.fit.values.get(metric, math.nan)
        words = [name, f"{segment.pixels.size} px", f"{metric} {value:.3g}" if math.isfinite(value) else ""]
        if segment.ratio is not None:
            words.append(f"ratio {segment.ratio:.3g}")
        if segment.division is not None:
            words.append(segment.division.value)
        if segment.is_leaf:
            words += [segment.stop.value] if segment.stop is not None else []
            words.append(f"object {object_of[segment.name]}" if result.tree.objects else "")
        label = "\\n".join(word for word in words if word)
        lines.append(f'  {name} [label="{label}"];')
        lines += [f"  {name} -> {display_name(child)};" for child in segment.children]
    return "\n".join([*lines, "}"]) + "\n"


def surfaces_npz(tree: SegmentationTree) -> bytes:
    """Return the surfaces of a tree's segments as an NPZ file.

    docs/files.md describes its arrays.
    """
    arrays: dict[str, Any] = {}
    names, degrees, windows = [], [], []
    for segment in tree.segments:
        name, surface = display_name(segment.name), segment.fit.surface
        arrays[f"{name}_measured"] = np.diff(np.sort(segment.fit.pixels), prepend=0).astype(np.int32)
        if surface is None:
            continue
        names.append(name)
        degrees.append(surface.degree)
        windows.append(surface.window)
        for part in ("knots_u", "knots_v", "control_points_m", "weights"):
            arrays[f"{name}_{part}"] = getattr(surface, part)
    arrays["names"] = np.array(names, dtype=np.str_)
    arrays["degree"] = np.array(degrees, dtype=np.int32).reshape(-1, 2)
    arrays["window"] = np.array(windows, dtype=np.int32).reshape(-1, 4)
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()
