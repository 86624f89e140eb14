"""Checks the evidence for merges, and repeats them."""

from collections.abc import Iterator
from itertools import combinations

from nurbseg.evaluation.check.exported import ExportedContact, ExportedFrame, ExportedMerge
from nurbseg.segmentation.objects.agglomeration import RENEWED
from nurbseg.segmentation.objects.pair_features import TERMS, merging_model

#: Evidence that a live tree adds for the state in the previous frame.
_KEPT = 1.0
#: Half of the last digit of evidence, and what several roundings of a sum can come to.
_HALF, _ROUNDINGS = 5.1e-4, 2e-3


def check_evidence(frame: ExportedFrame) -> None:
    """Compare the terms of every contact and merge with what they can be, and their sums with the log odds.

    What features come to follows from surfaces that were fitted anew before the merges: they are compared
    if the frames are segmented again.
    """
    base = merging_model().base
    weighed: list[ExportedContact | ExportedMerge] = [*frame.tree.contacts, *frame.tree.merges]
    for each in weighed:
        pair, kept = f"{each.first}-{each.second}", each.evidence.get("kept", 0.0)
        if each.evidence and not abs(each.evidence.get("base", 0.0) - base) <= _HALF:
            frame.wrong(pair, "evidence base", f"{base:.3f}", each.evidence.get("base"))
        for name in sorted(each.evidence.keys() - {*TERMS, "kept"}):
            frame.wrong(pair, f"evidence {name}", f"one of {', '.join(TERMS)}", each.evidence[name])
        most = 0.0 if frame.settings.independent else _KEPT
        if not abs(kept) <= most and (most == 0.0 or isinstance(each, ExportedContact)):
            frame.wrong(pair, "evidence kept", f"{-most:.3f} to {most:.3f}", kept)
    for contact in frame.tree.contacts:
        total = sum(contact.evidence.values())
        if not abs(total - contact.log_odds) <= _HALF:
            pair = f"{contact.first}-{contact.second}"
            frame.wrong(pair, "log_odds", f"{total:.3f}, the sum of its evidence", contact.log_odds)


class _Groups:
    """Leaves that have been merged, by the first leaf of each group, and the contacts between groups."""

    def __init__(self, frame: ExportedFrame) -> None:
        self._place = {leaf.name: place for place, leaf in enumerate(frame.leaves)}
        self.leaves = {leaf.name: {leaf.name} for leaf in frame.leaves}
        self._contacts = {
            frozenset((contact.first, contact.second)): contact for contact in frame.tree.contacts
        }

    def contacts(self, first: str, second: str) -> list[ExportedContact]:
        """Return the contacts between two groups."""
        pairs = (frozenset((one, other)) for one in self.leaves[first] for other in self.leaves[second])
        return [self._contacts[pair] for pair in pairs if pair in self._contacts]

    def log_odds(self, first: str, second: str, each: ExportedMerge | None) -> float | None:
        """Return those of two groups by their contacts and the evidence of a merge; None if none is known."""
        contacts = self.contacts(first, second)
        samples = sum(contact.samples for contact in contacts)
        if samples <= 0:
            return None
        if len(self.leaves[first]) == len(self.leaves[second]) == 1:
            return contacts[0].log_odds
        if each is None:
            return None
        kept = each.evidence.get("kept", 0.0)
        own = [contact.log_odds - contact.evidence.get("kept", 0.0) for contact in contacts]
        mean = sum(contact.samples * odds for contact, odds in zip(contacts, own, strict=True)) / samples
        return RENEWED * (sum(each.evidence.values()) - kept) + (1.0 - RENEWED) * mean + kept

    def merge(self, first: str, second: str) -> None:
        """Merge two groups."""
        kept, gone = sorted((first, second), key=self._place.__getitem__)
        self.leaves[kept] |= self.leaves.pop(gone)


def check_merges_again(frame: ExportedFrame) -> None:
    """Repeat the merges, and compare the log odds of each with those of its contacts.

    The contacts have to be sound: each of two leaves of the tree.
    """
    groups, least = _Groups(frame), frame.settings.config.extended.log_odds_min
    refused: set[frozenset[str]] = set()
    for merge in frame.tree.merges:
        pair = f"{merge.first}-{merge.second}"
        if merge.first == merge.second or not {merge.first, merge.second} <= groups.leaves.keys():
            frame.wrong(pair, "merges", "the first leaves of two groups", f"{merge.first} and {merge.second}")
            return
        expected = groups.log_odds(merge.first, merge.second, merge)
        if expected is None or not abs(expected - merge.log_odds) <= _ROUNDINGS:
            words = "a contact" if expected is None else f"{expected:.3f} by its contacts and evidence"
            frame.wrong(pair, "merges log_odds", words, merge.log_odds)
        frame.compare(pair, "merges merged", merge.log_odds > least, merge.merged, " by its log odds")
        if merge.merged:
            groups.merge(merge.first, merge.second)
        else:
            refused.add(frozenset((merge.first, merge.second)))
    for first, second in _that_meet(groups, refused):
        odds = groups.log_odds(first, second, None)
        if odds is None or odds > least:
            frame.wrong(f"{first}-{second}", "merges", "what became of the two groups, which meet", "none")
    _check_objects(frame, groups)


def _that_meet(groups: _Groups, refused: set[frozenset[str]]) -> Iterator[tuple[str, str]]:
    for first, second in combinations(groups.leaves, 2):
        if frozenset((first, second)) not in refused and groups.contacts(first, second):
            yield first, second


def _check_objects(frame: ExportedFrame, groups: _Groups) -> None:
    """Compare the objects with the groups."""
    stored = {frozenset(names) for names in frame.objects.values()}
    for group in sorted(sorted(names) for names in groups.leaves.values() if frozenset(names) not in stored):
        frame.wrong("", "objects", f"one of {', '.join(group)} by the log odds", "none")
