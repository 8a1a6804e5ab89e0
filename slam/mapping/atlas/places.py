"""Which keyframe shows a place like this one: vectors of locally aggregated descriptors (VLAD; Jégou et al., 2010).

A keyframe's descriptors are shared out to the nearest of some words, and their differences from it are added up: a
vector of fixed length. The words are learnt from the first keyframes of a run, by k-means from evenly chosen ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Vectors = NDArray[np.float32]

_LENGTH = 1024  # cost: of a keyframe's vector: 4 kB
_TRAINING = 50  # cost: descriptors for each word, before the words are learnt
_ROUNDS = 10  # numerics: of k-means


@dataclass(frozen=True)
class PlaceIndex:
    """Vectors of keyframes, and the words that they are made with.

    Attributes:
        words: (W, D); None while too few descriptors have been seen to learn them.
        early: descriptors (F, D) of the keyframes before the words were learnt.
        count: number of keyframes.
        vectors: theirs, in the first `count` rows.
    """

    words: Vectors | None = None
    early: tuple[Vectors, ...] = ()
    count: int = 0
    vectors: Vectors = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    def with_new(self, descriptors: Vectors) -> PlaceIndex:
        """With one more keyframe, of descriptors (F, D)."""
        if self.words is not None:
            return self._appended(aggregate(descriptors, self.words))
        early = (*self.early, descriptors)
        every = np.concatenate(early)
        number = max(_LENGTH // max(descriptors.shape[1], 1), 1)
        if len(every) < number * _TRAINING:
            return replace(self, early=early, count=self.count + 1)
        index = PlaceIndex(words=learn_words(every, number))
        for some in early:
            index = index._appended(aggregate(some, index.words))  # type: ignore[arg-type]
        return index

    def similarity(self, descriptors: Vectors) -> NDArray[np.float32]:
        """How similar each keyframe (count,) is to descriptors (F, D): 1 for the same, about 0 for another place."""
        if self.words is None:
            return np.zeros(self.count, np.float32)
        return np.asarray(self.vectors[: self.count] @ aggregate(descriptors, self.words))

    def _appended(self, vector: NDArray[np.float32]) -> PlaceIndex:
        """With one more vector. Rows beyond `count` are nobody's, so earlier indices keep theirs."""
        vectors = self.vectors
        if self.count >= len(vectors):
            vectors = np.zeros((max(64, 2 * self.count), len(vector)), np.float32)
            if self.count:
                vectors[: self.count] = self.vectors[: self.count]
        vectors[self.count] = vector
        return replace(self, vectors=vectors, count=self.count + 1)


def learn_words(descriptors: Vectors, number: int) -> Vectors:
    """Centres (number, D) of descriptors (F, D), by k-means from evenly chosen ones."""
    words = descriptors[np.linspace(0, len(descriptors) - 1, number).astype(int)].copy()
    for _ in range(_ROUNDS):
        nearest = _nearest(descriptors, words)
        count = np.bincount(nearest, minlength=number)
        total = np.stack([np.bincount(nearest, column, minlength=number) for column in descriptors.T], axis=1)
        used = count > 0
        words[used] = total[used] / count[used, None]
    return words


def aggregate(descriptors: Vectors, words: Vectors) -> NDArray[np.float32]:
    """The vector (W · D,) of descriptors (F, D), of length 1: each word's part is normalised first, then the whole."""
    parts = np.zeros_like(words)
    if len(descriptors):
        nearest = _nearest(descriptors, words)
        np.add.at(parts, nearest, descriptors - words[nearest])
    parts /= np.maximum(np.linalg.norm(parts, axis=1, keepdims=True), 1e-12)
    vector = parts.ravel()
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12), np.float32)


def _nearest(descriptors: Vectors, words: Vectors) -> NDArray[np.intp]:
    """Row of the nearest word (F,)."""
    squares = np.einsum("wd,wd->w", words, words)
    return np.asarray(np.argmin(squares[None, :] - 2 * descriptors @ words.T, axis=1))
