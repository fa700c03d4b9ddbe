"""Places that look alike: bags of binary words (Galvez-Lopez and Tardos 2012) with a vocabulary of the log's own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array

from posegraph_slam.arrays import FloatArray, IntArray
from posegraph_slam.jit import kernel

TRAINING_DESCRIPTORS = 20_000
"""Descriptors that the vocabulary is made from; more change little."""
ROUNDS = 4
BITS = 64


def appearance_similarity(descriptors: Sequence[np.ndarray], words: int, rng: np.random.Generator) -> FloatArray:
    """Return the similarity (K, K) in [0, 1] of images by their binary descriptors (n, 4) uint64 each.

    A vocabulary of `words` is clustered from a sample of all descriptors, an image is the weighted histogram of its
    words (tf-idf), and two images are as similar as the cosine between them. Images without descriptors resemble none.
    """
    count = len(descriptors)
    everything = np.concatenate(descriptors) if count else np.zeros((0, 4), np.uint64)
    if len(everything) == 0:
        return np.zeros((count, count))
    size = min(len(everything), TRAINING_DESCRIPTORS)
    sample = everything[np.sort(rng.choice(len(everything), size, replace=False))]
    vocabulary = train_vocabulary(sample, min(words, size), rng)
    rows = np.repeat(np.arange(count), [len(part) for part in descriptors])
    word = nearest_word(everything, vocabulary)
    ones = np.ones(len(word))
    histogram = csr_array((ones, (rows, word)), shape=(count, len(vocabulary)))
    histogram.sum_duplicates()
    images_with_word = np.bincount(histogram.indices, minlength=len(vocabulary))
    weight = np.log((count + 1) / (images_with_word + 0.5))
    values = histogram.data * np.maximum(weight, 0.0)[histogram.indices]
    length = np.sqrt(np.add.reduceat(np.append(values**2, 0.0), histogram.indptr[:-1]))
    length = np.where((np.diff(histogram.indptr) > 0) & (length > 0), length, 1.0)
    values = values / np.repeat(length, np.diff(histogram.indptr))
    unit = csr_array((values, histogram.indices, histogram.indptr), shape=histogram.shape)
    return np.asarray((unit @ unit.T).toarray())


def train_vocabulary(sample: np.ndarray, words: int, rng: np.random.Generator) -> np.ndarray:
    """Cluster descriptors (n, 4) uint64 into `words` centres by majority of each bit (Grana et al. 2013)."""
    centres = sample[np.sort(rng.choice(len(sample), words, replace=False))]
    for _ in range(ROUNDS):
        centres = majority(sample, nearest_word(sample, centres), centres)
    return centres


@kernel
def nearest_word(descriptors: np.ndarray, centres: np.ndarray) -> IntArray:
    """Row (n,) of the centre that differs in the fewest bits from each descriptor, the first of equals."""
    found = np.zeros(len(descriptors), np.int64)
    for i in range(len(descriptors)):
        least = 1 << 20
        for c in range(len(centres)):
            total = 0
            for w in range(descriptors.shape[1]):
                x = descriptors[i, w] ^ centres[c, w]
                x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
                x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
                x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
                total += int((x * np.uint64(0x0101010101010101)) >> np.uint64(56))
            if total < least:
                least, found[i] = total, c
    return found


@kernel
def majority(descriptors: np.ndarray, member: IntArray, centres: np.ndarray) -> np.ndarray:
    """Centres (m, 4) whose every bit is that of most members; a centre without members stays."""
    votes = np.zeros((len(centres), centres.shape[1], BITS), np.int64)
    sizes = np.zeros(len(centres), np.int64)
    for i in range(len(descriptors)):
        sizes[member[i]] += 1
        for w in range(descriptors.shape[1]):
            for bit in range(BITS):
                votes[member[i], w, bit] += np.int64((descriptors[i, w] >> np.uint64(bit)) & np.uint64(1))
    result = centres.copy()
    for c in range(len(centres)):
        if sizes[c] == 0:
            continue
        for w in range(centres.shape[1]):
            value = np.uint64(0)
            for bit in range(BITS):
                if 2 * votes[c, w, bit] > sizes[c]:
                    value |= np.uint64(1) << np.uint64(bit)
            result[c, w] = value
    return result
