"""Notes of a reader: what it repaired, supplied or left out, for the person whose file it is."""

from __future__ import annotations

NAMED = 5
"""Number of features that a note names."""


class ReadingNotes:
    """Collects notes; each sentence appears once, with the features that it is about."""

    def __init__(self) -> None:
        self._features: dict[str, list[int]] = {}

    def add(self, sentence: str, feature: int | None = None) -> None:
        """Note something of one feature (its position in the file, from 0), or of the file as a whole."""
        features = self._features.setdefault(sentence, [])
        if feature is not None and (not features or features[-1] != feature):
            features.append(feature)

    def sentences(self) -> tuple[str, ...]:
        """Return the notes in the order in which they first came up."""
        return tuple(map(self._told, self._features))

    def _told(self, sentence: str) -> str:
        features = sorted(set(self._features[sentence]))
        if not features:
            return sentence
        named = ", ".join(map(str, features[:NAMED])) + (" ..." if len(features) > NAMED else "")
        return f"{sentence} ({len(features)} x: feature {named})"
