"""The evidence on two surfaces that meet, in words: whether they are one object."""

from collections.abc import Mapping

from nurbseg.segmentation.objects.merge import Contact
from nurbseg.segmentation.vocabulary import display_name

#: What a term of the log odds says if it is for one object, and if it is against.
_TERMS: Mapping[str, tuple[str, str]] = {
    "crease": ("their edge is like one within an object", "their edge is like one between objects"),
    "gap": ("they touch", "there is a step between them"),
    "border": ("they share much of their borders", "they share little of their borders"),
    "size": ("neither is large", "one is large"),
    "flatness": ("together they are as flat as apart", "together they are less flat than apart"),
    "shape": ("together they are compact", "together they are not compact"),
    "height": ("their heights over the support go together", "their heights over the support differ"),
    "orientation": ("they face as parts of one object do", "they face as different objects do"),
    "kept": ("they were one object before", "they were different objects before"),
}


def contact(each: Contact) -> str:
    """Return the evidence on a pair of leaves that meet, with its log odds."""
    pair = f"{display_name(each.first)} and {display_name(each.second)}"
    return f"{pair}: log odds {each.log_odds:+.2f}: {evidence(each)}"


def evidence(each: Contact) -> str:
    """Return the two strongest terms of a pair's log odds."""
    return ", ".join(f"{_TERMS[name][value < 0]} ({value:+.1f})" for name, value in _strongest(each))


def reasons_for(each: Contact) -> list[str]:
    """Return the two strongest reasons why a pair is one object; fewer if there are not as many."""
    return [_TERMS[name][0] for name, _ in _strongest(each, positive=True)]


def _strongest(each: Contact, *, positive: bool = False) -> list[tuple[str, float]]:
    """Return the two terms of a pair's log odds that count most, or of those for one object."""
    terms = [(name, value) for name, value in each.evidence.items() if name in _TERMS]
    terms = [(name, value) for name, value in terms if value > 0 or not positive]
    return sorted(terms, key=lambda term: -abs(term[1]))[:2]
