"""Place recognition by vectors of locally aggregated descriptors (VLAD; Jégou et al., 2010).

Each descriptor of a keyframe is assigned to the nearest visual word, and the differences from each word are summed: a
vector of fixed length. The words are learnt by k-means from all keyframes so far, several times at first: words learnt
from few places lie at the means of their descriptors, whose differences then cancel, so that just those places would
not be recognised. For the same reason the vectors' mean is subtracted before they are compared.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2, vq

Vectors = NDArray[np.float32]

_LENGTH = 1024  # cost: of a keyframe's vector: 4 kB
_LEARN_AT = (8, 16, 32, 64, 128)  # cost: numbers of keyframes at which the words are learnt
_NONE = 1e-12  # numerics: length below which a vector counts as zero


@dataclass(frozen=True, eq=False)
class PlaceIndex:
    """VLAD vectors of keyframes, and the visual words they are made with."""

    words: Vectors | None = None  # (W, D); None before they have been learnt
    early: tuple[NDArray[np.float16], ...] = ()  # descriptors (F, D) of the keyframes, while words are to be learnt
    count: int = 0  # number of keyframes
    vectors: Vectors | None = None  # of the keyframes (count, W · D); None without words

    def with_new(self, descriptors: NDArray[np.float16]) -> PlaceIndex:
        """A copy with one more keyframe, which has descriptors (F, D)."""
        count = self.count + 1
        early = (*self.early, descriptors) if count <= _LEARN_AT[-1] else ()
        if count not in _LEARN_AT:
            return replace(self._appended(descriptors), early=early)
        every = np.concatenate(early).astype(np.float32)
        number = min(max(_LENGTH // max(every.shape[1], 1), 1), len(every))
        index = PlaceIndex(words=learn_words(every, number) if number else None)
        for some in early:
            index = index._appended(some)
        return replace(index, early=early if count < _LEARN_AT[-1] else ())

    def similarity(self, descriptors: Vectors) -> NDArray[np.float32]:
        """How similar each keyframe (count,) is to descriptors (F, D): 1 for the same, about 0 for another place."""
        if self.words is None or self.vectors is None:
            return np.zeros(self.count, np.float32)
        vectors, mean = self.vectors, self.vectors.mean(axis=0)
        wanted = aggregate(descriptors, self.words) - mean
        products = vectors @ np.stack([wanted, mean], axis=1)
        squares = np.einsum("kn,kn->k", vectors, vectors) - 2 * products[:, 1] + mean @ mean
        lengths = np.sqrt(np.maximum(squares, 0)) * np.linalg.norm(wanted)
        return np.asarray((products[:, 0] - mean @ wanted) / np.maximum(lengths, _NONE), np.float32)

    def _appended(self, descriptors: NDArray[np.float16]) -> PlaceIndex:
        """A copy with one more keyframe."""
        if self.words is None:
            return replace(self, count=self.count + 1)
        vector = aggregate(descriptors.astype(np.float32), self.words)[None]
        vectors = vector if self.vectors is None else np.concatenate([self.vectors, vector])
        return replace(self, vectors=vectors, count=self.count + 1)


def learn_words(descriptors: Vectors, number: int) -> Vectors:
    """Centres (number, D) of descriptors (F, D), by k-means on an evenly spaced subset."""
    some = min(50 * number, len(descriptors))
    descriptors = descriptors[np.linspace(0, len(descriptors) - 1, some).astype(int)]
    first = descriptors[np.linspace(0, some - 1, number).astype(int)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a word without descriptors stays where it is
        return np.asarray(kmeans2(descriptors, first, minit="matrix")[0], np.float32)


def aggregate(descriptors: Vectors, words: Vectors) -> NDArray[np.float32]:
    """VLAD vector (W · D,) of descriptors (F, D): each word's part is normalised, then the whole, to unit length."""
    members = (vq(descriptors, words)[0] == np.arange(len(words))[:, None]).astype(np.float32)
    parts = members @ descriptors - members.sum(axis=1)[:, None] * words
    parts /= np.maximum(np.linalg.norm(parts, axis=1, keepdims=True), _NONE)
    vector = parts.ravel()
    return np.asarray(vector / max(float(np.linalg.norm(vector)), _NONE), np.float32)
