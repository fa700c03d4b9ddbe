"""Point features of RGB-D frames: ORB keypoints with their 3D points, and how those of two frames are paired."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from posegraph_slam.arrays import Float32Array, FloatArray, IntArray, read_only
from posegraph_slam.jit import kernel

FEATURES = 2000
"""Keypoints looked for in an image,"""
MANY_FEATURES = 5000
"""and where these do not do: of two views 25 degrees apart they give three times as many right matches."""
WORDS = 4
"""A descriptor of 256 bits as 64-bit words."""
RATIO, DISTANCE_MAX = 0.9, 80
"""The best match must be nearer than this share of the second best (Lowe 2004), and not differ in more bits."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """Keypoints with depth: `points` (n, 3) in the camera frame, `pixels` (n, 2) [u, v], `words` (n, 4) uint64.

    Ordered by response, strongest first; `camera` is [fx, fy, cx, cy].
    """

    points: FloatArray
    pixels: FloatArray
    words: np.ndarray
    camera: FloatArray

    def __post_init__(self) -> None:
        for name in ("points", "pixels", "camera"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "words", read_only(self.words, np.uint64))

    def __len__(self) -> int:
        return int(self.points.shape[0])


def detect_features(
    intensity: Float32Array, depth: Float32Array, camera: FloatArray, *, most: int = FEATURES
) -> Features:
    """Find up to `most` ORB keypoints (Rublee et al. 2011), and keep those with depth.

    `intensity` and `depth` (h, w) are those of one level of a frame, `camera` its [fx, fy, cx, cy].
    """
    grey = np.clip(np.rint(intensity), 0, 255).astype(np.uint8)
    detector = cv2.ORB_create(nfeatures=most, fastThreshold=7)  # type: ignore[attr-defined]
    keypoints, descriptors = detector.detectAndCompute(grey, None)
    if descriptors is None:
        descriptors = np.zeros((0, 32), np.uint8)
    pixels = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2)
    response = np.array([k.response for k in keypoints], dtype=np.float64)
    z = _depth_at(depth, pixels)
    kept = np.flatnonzero(z > 0)
    # ties in response are broken by the place, so that the order does not depend on the detector's
    kept = kept[np.lexsort((pixels[kept, 0], pixels[kept, 1], -response[kept]))]
    fx, fy, cx, cy = camera
    uv, z = pixels[kept], z[kept]
    points = np.column_stack([(uv[:, 0] - cx) / fx * z, (uv[:, 1] - cy) / fy * z, z])
    words = np.ascontiguousarray(descriptors[kept]).view(np.uint64).reshape(-1, WORDS)
    return Features(points=points, pixels=uv, words=words, camera=camera)


def _depth_at(depth: Float32Array, pixels: FloatArray) -> FloatArray:
    """Least depth (n,) in the 3 x 3 pixels about each place, 0 where none is known: a corner belongs to what is nearer.

    Looking one pixel aside finds a depth for corners on outlines, where sensors often measure none.
    """
    rows = np.clip(np.rint(pixels[:, 1]).astype(np.int64), 1, depth.shape[0] - 2)
    columns = np.clip(np.rint(pixels[:, 0]).astype(np.int64), 1, depth.shape[1] - 2)
    offsets = [(di, dj) for di in (-1, 0, 1) for dj in (-1, 0, 1)]
    around = np.stack([depth[rows + di, columns + dj] for di, dj in offsets]).astype(np.float64)
    nearest = np.where(around > 0, around, np.inf).min(axis=0, initial=np.inf)
    return np.where(np.isfinite(nearest), nearest, 0.0)


def match_features(target: Features, source: Features) -> IntArray:
    """Pair features (m, 2) [target, source] that are each other's nearest, near enough and clearly nearest."""
    if len(target) < 2 or len(source) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    pairs = mutual_nearest(target.words, source.words, RATIO, DISTANCE_MAX)
    return np.asarray(pairs)


@kernel
def hamming(a: np.ndarray, b: np.ndarray) -> int:
    """Bits in which two descriptors (4,) uint64 differ."""
    total = 0
    for w in range(len(a)):
        x = a[w] ^ b[w]
        x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
        x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
        x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
        total += int((x * np.uint64(0x0101010101010101)) >> np.uint64(56))
    return total


@kernel
def mutual_nearest(target: np.ndarray, source: np.ndarray, ratio: float, most: int) -> IntArray:
    """Rows (m, 2) of descriptors that are each other's nearest, within `most` bits and clear of the second nearest."""
    n, m = len(target), len(source)
    best_s, best_t = np.full(n, -1), np.full(m, -1)
    first_t = np.full(m, 1 << 20)
    first_s, second_s = np.full(n, 1 << 20), np.full(n, 1 << 20)
    for i in range(n):
        for j in range(m):
            d = hamming(target[i], source[j])
            if d < first_s[i]:
                second_s[i], first_s[i], best_s[i] = first_s[i], d, j
            elif d < second_s[i]:
                second_s[i] = d
            if d < first_t[j]:
                first_t[j], best_t[j] = d, i
    pairs = np.empty((n, 2), np.int64)
    count = 0
    for i in range(n):
        j = best_s[i]
        if j >= 0 and best_t[j] == i and first_s[i] <= most and first_s[i] <= ratio * second_s[i]:
            pairs[count, 0], pairs[count, 1] = i, j
            count += 1
    return pairs[:count]
