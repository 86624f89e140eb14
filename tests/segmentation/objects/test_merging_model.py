"""The model of merging: that its terms add up to the sum of its trees."""

from importlib.resources import files

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


def nodes_of_the_package():
    with files("nurbseg.segmentation.objects").joinpath("merging_model.npy").open("rb") as file:
        return np.load(file)


def roots_of(nodes):
    return sorted(set(range(nodes.size)) - {*nodes["low"].tolist(), *nodes["high"].tolist()})


def by_hand(nodes, features):
    """Sum of the leaves that features lead to, tree by tree."""
    total = 0.0
    for node in roots_of(nodes):
        while nodes["low"][node] >= 0:
            is_below = features[nodes["feature"][node]] <= nodes["threshold"][node]
            node = nodes["low" if is_below else "high"][node]
        total += float(nodes["value"][node])
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
    assert model.base == 1.5
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
    nodes, rng = nodes_of_the_package(), np.random.default_rng(seed)
    features = rng.normal(0, 2, FEATURES)
    terms = terms_of(merging_model(), features)
    assert sum(terms.values()) == pytest.approx(by_hand(nodes, features), abs=1e-9)
    assert all(terms.values())


@pytest.mark.parametrize("special", [np.nan, np.inf, -np.inf])
def test_features_at_thresholds_and_beyond_all_of_them_lead_to_the_same_leaves(special):
    nodes, rng = nodes_of_the_package(), np.random.default_rng(0)
    inner = nodes[nodes["low"] >= 0]
    features = np.array(
        [
            rng.choice(inner["threshold"][inner["feature"] == k], 1)[0] if k in inner["feature"] else 0.0
            for k in range(FEATURES)
        ],
        dtype=np.float64,
    )
    for k in range(FEATURES):
        changed = features.copy()
        changed[k] = special
        total = sum(terms_of(merging_model(), changed).values())
        assert total == pytest.approx(by_hand(nodes, changed), abs=1e-9)


def test_a_tree_of_as_many_leaves_as_a_mask_has_bits_reaches_each_and_of_more_is_refused():
    def chain(leaves):
        """Return a tree in which a leaf is chosen by how many whole numbers the feature is above."""
        nodes = np.zeros(2 * leaves - 1, dtype=NODE)
        nodes["low"] = nodes["high"] = -1
        for n in range(leaves - 1):
            nodes["low"][2 * n], nodes["high"][2 * n], nodes["threshold"][2 * n] = 2 * n + 1, 2 * n + 2, n
        nodes["value"][[*range(1, 2 * leaves - 2, 2), 2 * leaves - 2]] = range(leaves)
        return nodes

    model = model_of(chain(32))
    for leaf in range(32):
        features = np.zeros(FEATURES)
        features[0] = leaf - 0.5
        assert sum(terms_of(model, features).values()) == leaf
    with pytest.raises(ValueError, match="32 leaves"):
        model_of(chain(33))


def test_every_group_of_features_has_a_part_in_the_model():
    nodes = nodes_of_the_package()
    inner = nodes[nodes["low"] >= 0]
    used = {NAMES[feature] for feature in inner["feature"]}
    assert all(used & set(names) for names in GROUPS.values())
    # Every node but the roots is below one other.
    below = [*inner["low"].tolist(), *inner["high"].tolist()]
    assert sorted([*below, *roots_of(nodes)]) == list(range(nodes.size))
