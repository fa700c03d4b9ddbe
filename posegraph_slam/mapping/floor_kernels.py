"""Kernels of the floor map: one pass over the pixels of a depth image each.

Labels of a pixel: 0 says nothing, 1 floor, 2 obstacle, 3 neither: it keeps a cell from being called floor.
"""

from __future__ import annotations

from posegraph_slam.arrays import ByteArray, Float32Array, FloatArray, IntArray
from posegraph_slam.jit import inline_kernel, kernel

UNLABELLED, FLOOR, OBSTACLE, OTHER = 0, 1, 2, 3


@inline_kernel
def whole(value: float) -> int:
    """Largest whole number that is not above `value`; quicker than a call of floor."""
    k = int(value)
    return k - 1 if value < k else k


@kernel
def label_by_distance(
    depth: Float32Array,
    rows: FloatArray,
    columns: FloatArray,
    constant: float,
    limits: tuple[float, float],
    heights: tuple[float, float, float],
    first_obstacle_row: int,
    labels: ByteArray,
) -> None:
    """Label pixels by their distance depth (rows[i] + columns[j]) + constant above a plane.

    Floor between the first two `heights`; obstacle above up to the third, from `first_obstacle_row` downwards in the
    image; other above that row, and anything below the floor. Depths outside `limits` say nothing.
    """
    nearest, farthest = limits
    lowest, highest, clearance = heights
    for i in range(depth.shape[0]):
        above = OBSTACLE if i >= first_obstacle_row else OTHER
        for j in range(depth.shape[1]):
            z = depth[i, j]
            label = UNLABELLED
            if nearest <= z <= farthest:
                distance = z * (rows[i] + columns[j]) + constant
                if distance < lowest:
                    label = OTHER
                elif distance <= highest:
                    label = FLOOR
                elif distance <= clearance:
                    label = above
            labels[i, j] = label


@kernel
def label_by_range(
    depth: Float32Array,
    rows: FloatArray,
    columns: FloatArray,
    constant: FloatArray,
    limits: tuple[float, float],
    highest: float,
    ranges: tuple[float, float],
    min_points: int,
    corner: tuple[int, int],
    low: Float32Array,
    high: Float32Array,
    count: IntArray,
    labels: ByteArray,
) -> None:
    """Label pixels by the range of heights in their cell.

    Coordinates are x and y in cells, and height. `low`, `high` and `count` (R, C) are scratch of the window of cells
    whose corner (row, column) is `corner`, filled with +inf, -inf and 0; they hold the cells' heights afterwards.
    """
    nearest, farthest = limits
    floor_range, obstacle_range = ranges
    for phase in range(2):
        for i in range(depth.shape[0]):
            for j in range(depth.shape[1]):
                if phase == 1:
                    labels[i, j] = UNLABELLED
                z = depth[i, j]
                if not nearest <= z <= farthest:
                    continue
                height = z * (rows[i, 2] + columns[j, 2]) + constant[2]
                if height > highest:
                    continue
                c = whole(z * (rows[i, 0] + columns[j, 0]) + constant[0]) - corner[1]
                r = whole(z * (rows[i, 1] + columns[j, 1]) + constant[1]) - corner[0]
                if not (0 <= r < low.shape[0] and 0 <= c < low.shape[1]):
                    continue
                if phase == 0:
                    low[r, c] = min(low[r, c], height)
                    high[r, c] = max(high[r, c], height)
                    count[r, c] += 1
                elif count[r, c] >= min_points:
                    span = high[r, c] - low[r, c]
                    if span <= floor_range:
                        labels[i, j] = FLOOR
                    elif span >= obstacle_range:
                        labels[i, j] = OBSTACLE
                    else:
                        labels[i, j] = OTHER


@kernel
def count_labels(
    depth: Float32Array,
    labels: ByteArray,
    rows: FloatArray,
    columns: FloatArray,
    constant: FloatArray,
    corner: tuple[int, int],
    counts: IntArray,
) -> None:
    """Count labels 1 to 3 in the cells of a window: `counts` (R, C, 3) from cell (row, column) `corner`.

    Coordinates are x and y in cells of the map.
    """
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            label = labels[i, j]
            if label == UNLABELLED:
                continue
            z = depth[i, j]
            c = whole(z * (rows[i, 0] + columns[j, 0]) + constant[0]) - corner[1]
            r = whole(z * (rows[i, 1] + columns[j, 1]) + constant[1]) - corner[0]
            if 0 <= r < counts.shape[0] and 0 <= c < counts.shape[1]:
                counts[r, c, label - 1] += 1


@kernel
def cast_votes(counts: IntArray, min_pixels: int, corner: tuple[int, int], votes: IntArray) -> None:
    """Add the verdict of one frame to `votes` (R, C, 2) [floor, obstacle]; the window must lie inside the grid.

    A cell is floor where most of its pixels are, an obstacle where obstacles are at least as many as floor.
    """
    for r in range(counts.shape[0]):
        for c in range(counts.shape[1]):
            floor, obstacle, other = counts[r, c, 0], counts[r, c, 1], counts[r, c, 2]
            if floor + obstacle + other < min_pixels:
                continue
            if floor > obstacle + other:
                votes[corner[0] + r, corner[1] + c, 0] += 1
            elif obstacle > 0 and obstacle >= floor:
                votes[corner[0] + r, corner[1] + c, 1] += 1


@kernel
def bottom_points(
    depth: Float32Array,
    down: FloatArray,
    right: FloatArray,
    limits: tuple[float, float],
    first_row: int,
    stride: int,
    points: FloatArray,
) -> int:
    """Fill `points` (N, 3) [1 / depth, right, down] with every `stride`-th pixel from `first_row` on; return how many.

    `limits` are the nearest and farthest depth that count; `points` must have room for all.
    """
    used = 0
    for i in range(first_row, depth.shape[0], stride):
        for j in range(0, depth.shape[1], stride):
            z = depth[i, j]
            if limits[0] <= z <= limits[1]:
                points[used, 0], points[used, 1], points[used, 2] = 1.0 / z, right[j], down[i]
                used += 1
    return used


@inline_kernel
def on_plane(w: float, right: float, down: float, plane: FloatArray, tolerance: float) -> bool:
    """Whether a pixel lies within `tolerance` |n| of 1 / depth = plane . [1, right, down], |n| included by the caller.

    The point X = z (1, right, down) has the distance |n . X - 1| / |n| from the plane n . X = 1, and n = `plane`.
    """
    gap = (plane[0] + plane[1] * right + plane[2] * down) - w
    return bool(abs(gap) <= tolerance * w)


@kernel
def best_plane(points: FloatArray, triples: IntArray, inlier: float, plane: FloatArray) -> int:
    """Fill `plane` (3,) with the plane through one of `triples` (K, 3) of `points` with the most inliers; return them.

    Points are (N, 3) [1 / depth, right, down]; the first of equally good planes wins; 0 where no triple spans one.
    """
    best, trial = 0, plane.copy()
    for k in range(triples.shape[0]):
        a, b, c = points[triples[k, 0]], points[triples[k, 1]], points[triples[k, 2]]
        bx, by, cx, cy = b[1] - a[1], b[2] - a[2], c[1] - a[1], c[2] - a[2]
        area = bx * cy - by * cx
        if abs(area) < 1e-9:
            continue
        trial[1] = ((b[0] - a[0]) * cy - (c[0] - a[0]) * by) / area
        trial[2] = ((c[0] - a[0]) * bx - (b[0] - a[0]) * cx) / area
        trial[0] = a[0] - trial[1] * a[1] - trial[2] * a[2]
        tolerance = inlier * (trial[0] ** 2 + trial[1] ** 2 + trial[2] ** 2) ** 0.5
        inliers = 0
        for m in range(points.shape[0]):
            if on_plane(points[m, 0], points[m, 1], points[m, 2], trial, tolerance):
                inliers += 1
        if inliers > best:
            best = inliers
            plane[:] = trial
    return best


@kernel
def plane_sums(points: FloatArray, plane: FloatArray, inlier: float, sums: FloatArray) -> int:
    """Fill `sums` (3, 4) with the normal equations of 1 / depth over the inliers of `plane`; return their number.

    Noise of 1 / depth is the same at every depth for a camera that measures disparity: no weights are needed.
    """
    tolerance = inlier * (plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2) ** 0.5
    sums[:] = 0.0
    used = 0
    for m in range(points.shape[0]):
        w, x, y = points[m, 0], points[m, 1], points[m, 2]
        if on_plane(w, x, y, plane, tolerance):
            used += 1
            sums[0, 1] += x
            sums[0, 2] += y
            sums[0, 3] += w
            sums[1, 1] += x * x
            sums[1, 2] += x * y
            sums[1, 3] += x * w
            sums[2, 2] += y * y
            sums[2, 3] += y * w
    sums[0, 0] = used
    sums[1, 0], sums[2, 0], sums[2, 1] = sums[0, 1], sums[0, 2], sums[1, 2]
    return used
