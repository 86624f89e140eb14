"""The model of merging: that its terms add up to the sum of its trees."""

import numpy as np
import pytest

from nurbseg.segmentation.objects.pair_features import (
    FEATURES,
    GROUPS,
    NAMES,
    NODE,
    TERMS,
    add_terms,
    merging_model,
    model_of,
)


def terms_of(model, features):
    terms = np.zeros(len(TERMS))
    add_terms(terms, np.asarray(features, dtype=np.float64), model)
    return dict(zip(TERMS, terms.tolist(), strict=True))


def by_hand(model, features):
    """Sum of the leaves that features lead to, tree by tree."""
    total = 0.0
    for root in model.roots:
        node = root
        while model.low[node] >= 0:
            follow = model.low if features[model.feature[node]] <= model.threshold[node] else model.high
            node = follow[node]
        total += model.value[node]
    return total


def test_a_feature_contributes_what_its_decisions_change():
    nodes = np.zeros(6, dtype=NODE)
    nodes["low"] = nodes["high"] = -1
    nodes["value"] = [0.5, 1.0, -2.0, 4.0, 3.0, 5.0]
    # A constant, and a tree of two decisions: on the crease, then on the height.
    nodes["low"][[1, 3]], nodes["high"][[1, 3]] = [2, 4], [3, 5]
    nodes["feature"][[1, 3]] = NAMES.index("uneven"), NAMES.index("tall")
    nodes["threshold"][[1, 3]] = 0.25, 2.0
    model = model_of(nodes)
    assert model.roots.tolist() == [0, 1]
    features = np.zeros(FEATURES)
    assert {k: v for k, v in terms_of(model, features).items() if v} == {"base": 1.5, "crease": -3.0}
    features[[NAMES.index("uneven"), NAMES.index("tall")]] = 0.3, 2.5
    found = terms_of(model, features)
    assert {k: v for k, v in found.items() if v} == {"base": 1.5, "crease": 3.0, "height": 1.0}
    # At the threshold the way leads down.
    features[NAMES.index("tall")] = 2.0
    assert terms_of(model, features)["height"] == -1.0


@pytest.mark.parametrize("seed", range(5))
def test_the_terms_of_the_package_add_up_to_its_trees(seed):
    model, rng = merging_model(), np.random.default_rng(seed)
    features = rng.normal(0, 2, FEATURES)
    terms = terms_of(model, features)
    assert sum(terms.values()) == pytest.approx(by_hand(model, features), abs=1e-9)
    assert all(terms.values())


def test_every_group_of_features_has_a_part_in_the_model():
    model = merging_model()
    inner = model.low >= 0
    used = {NAMES[feature] for feature in model.feature[inner]}
    assert all(used & set(names) for names in GROUPS.values())
    assert np.array_equal(model.term[inner] > 0, np.ones(inner.sum(), dtype=bool))
    # Every node but the roots is below one other.
    below = np.concatenate([model.low[inner], model.high[inner]])
    assert sorted([*below.tolist(), *model.roots.tolist()]) == list(range(model.low.size))
