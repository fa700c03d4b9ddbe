"""Free cells of a scan by filling the polygon of its returns: the only place in this room that uses OpenCV."""

from __future__ import annotations

import cv2
import numpy as np

from posegraph_slam.arrays import FloatArray
from posegraph_slam.localization.cell_counts import refresh_free_before
from posegraph_slam.localization.slam_map import SlamMap, refresh_near
from posegraph_slam.mapping.raycast import NEVER_SEEN


def draw_scan_by_polygon(slam_map: SlamMap, points: FloatArray, pose: FloatArray, sensor: FloatArray) -> None:
    """Add a scan like `draw_scan`, its free cells being the inside of the polygon sensor, return, return, ...

    The polygon closes the gaps between beams, which rays leave open far from the sensor, and needs the returns in the
    order of their bearings. Cells on its edge that hold no return count as free too.
    """
    cells = slam_map.geometry.cells_from_map
    c, s = np.cos(pose[2]), np.sin(pose[2])
    corners = np.concatenate([sensor[None], points]) @ np.array([[c, s], [-s, c]]) + pose[:2]
    corners = np.floor(corners @ cells[:2, :2].T + cells[:2, 2]).astype(np.int32)
    low, high = corners.min(axis=0), corners.max(axis=0)
    rows, columns = slam_map.geometry.shape
    if (low < 0).any() or high[0] >= columns or high[1] >= rows:
        return
    mask = np.zeros((high[1] - low[1] + 1, high[0] - low[0] + 1), dtype=np.uint8)
    cv2.drawContours(mask, [(corners - low)[:, None]], -1, 1, cv2.FILLED)
    ends = corners[1:] - low
    mask[ends[:, 1], ends[:, 0]] = 2
    hit, miss, clamp, above = slam_map.steps
    window = slam_map.evidence[low[1] : high[1] + 1, low[0] : high[0] + 1]
    before = np.where(window == NEVER_SEEN, 0, window)
    after = np.clip(before + np.array([0, -miss, hit])[mask], -clamp, clamp)
    changes = np.argwhere((before > above) != (after > above))
    np.copyto(window, after.astype(np.int32), where=mask > 0)
    refresh_near(changes + low[::-1], slam_map.evidence, above, slam_map.reach, slam_map.near)
    if slam_map.free_before is not None:
        refresh_free_before(slam_map.evidence, slam_map.free_before, low[1], high[1] + 1, low[0], high[0] + 1)
