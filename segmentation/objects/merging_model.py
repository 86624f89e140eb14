"""The model of merging: boosted trees, and what each group of features contributes to their sum."""

from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from nurbseg.common.compiled import F64, I32, compiled
from nurbseg.segmentation.objects.pair_features import GROUPS

#: Terms of the log odds: a constant, then what each group of features adds.
TERMS = ("base", *GROUPS)
#: Fields of a node: feature, threshold, nodes at or below and above it, and value. A leaf has no nodes below
#: it (-1) and is a part of the log odds; other nodes have the mean of the leaves below them.
NODE = np.dtype([("feature", "u1"), ("threshold", "f4"), ("low", "i2"), ("high", "i2"), ("value", "f4")])


class MergingModel(NamedTuple):
    """Regression trees whose sum is the log odds of two surfaces being one object, for compiled loops.

    Parameters
    ----------
    feature, term : (N,) int32
        Of each node: the feature that decides, and the place of its group in `TERMS`.
    threshold, value : (N,) float64
        The way leads to `low` if the feature is at most the threshold; mean of the leaves below.
    low, high : (N,) int32
        Following nodes; -1 at leaves.
    roots : (T,) int32
        First node of each tree.
    """

    feature: I32
    term: I32
    threshold: F64
    value: F64
    low: I32
    high: I32
    roots: I32


def model_of(nodes: np.ndarray) -> MergingModel:
    """Make a model of its nodes, an array of dtype `NODE` in which every tree begins with its root."""
    terms = [place for place, names in enumerate(GROUPS.values(), start=1) for _ in names]
    low, high = (nodes[name].astype(np.int32) for name in ("low", "high"))
    roots = np.setdiff1d(np.arange(nodes.size), np.concatenate([low, high])).astype(np.int32)
    feature = nodes["feature"].astype(np.int32)
    threshold, value = (nodes[name].astype(np.float64) for name in ("threshold", "value"))
    return MergingModel(feature, np.array(terms, dtype=np.int32)[feature], threshold, value, low, high, roots)


@cache
def merging_model() -> MergingModel:
    """Return the model of the package; docs/merging-model.md says what it was trained on."""
    with files(__package__).joinpath("merging_model.npy").open("rb") as file:
        return model_of(np.load(file))


@compiled
def add_terms(terms: F64, features: F64, model: MergingModel) -> None:
    """Add the terms of the log odds, (len(TERMS),) float64; their sum is that of the leaves.

    A node's feature contributes the change of the mean from the node to the next one on the way [1]_.

    References
    ----------
    .. [1] A. Saabas, "Interpreting random forests", 2014.
    """
    for root in model.roots:
        node = root
        terms[0] += model.value[node]
        while model.low[node] >= 0:
            below = features[model.feature[node]] <= model.threshold[node]
            following = model.low[node] if below else model.high[node]
            terms[model.term[node]] += model.value[following] - model.value[node]
            node = following
