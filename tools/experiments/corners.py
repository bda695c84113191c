#!/usr/bin/env python3
"""Measures in photographs how far the corners of square markers are from their positions by the marker's own cells.

    python3 tools/experiments/corners.py COMMAND FAMILY IMAGE...

COMMAND is the path of `alight`, FAMILY one that OpenCV or AprilTag 3 knows as well, such as apriltag-36h11 or aruco-4x4-50. Markers that every
detector finds are compared; corners of the references are sub-pixel ones.

No photograph shows the true position of a corner, and references that move an edge in the same sense agree with each other. But the effect of a
camera's tone curve on a blurred edge, and of ink on paper, moves edges from black to white and from white to black in opposite senses, by
the same amount. So the positions of the edges between a marker's cells are fitted with one projection and one such movement along each axis; the
projection then gives the corners without it. The outline itself, on which all detectors rest, takes no part. Prints whose cells are not as
wide as the design has them (MAX_RESIDUAL_CELLS) are left out, and markers of cells that are too small to see an edge alone (MIN_CELL_PX).
"""

import collections
import json
import math
import statistics
import subprocess
import sys

import references
from references import cv2, np

# Half an edge's profile and its step, and the positions of profiles along the edge; in cells.
REACH, STEP, ALONG = 0.5, 0.05, (0.35, 0.5, 0.65)
# Of intensities, between the two sides of an edge.
MIN_CONTRAST = 25.0
MIN_EDGES = 40
MIN_CELL_PX = 8.0
# Standard deviation of the edges' positions about the fit.
MAX_RESIDUAL_CELLS = 0.03


def cells_of(family):
    """Cells along a side, with the border of one cell."""
    kind = family.split("-")[1]
    bits = {"16h5": 4, "25h9": 5, "36h11": 6}.get(kind)
    return 2 + (bits if bits else int(kind[0]))


def same_order(corners, quad):
    """`quad` with its corners in the order of `corners`."""
    turned = (np.roll(quad[::way], turn, 0) for way in (1, -1) for turn in range(4))
    return min(turned, key=lambda other: np.abs(other - corners).max())


def crossing(profile, places):
    """The position at which a profile passes the mean of its two ends; `None` when it does so more than once."""
    first, last = profile[:3].mean(), profile[-3:].mean()
    if abs(last - first) < MIN_CONTRAST:
        return None
    above = profile > (first + last) / 2.0
    at = np.flatnonzero(above[1:] != above[:-1])
    if len(at) != 1:
        return None
    i = at[0]
    return places[i] + STEP * ((first + last) / 2.0 - profile[i]) / (profile[i + 1] - profile[i])


def edges_between_cells(grey, to_image, cells):
    """Axis, position across and along in cells, offset from there, and sense of brightness, of each edge."""

    def sample(points):
        points = np.c_[points, np.ones(len(points))] @ to_image.T
        x, y = (points[:, i] / points[:, 2] for i in (0, 1))
        return cv2.remap(grey, x[None].astype(np.float32), y[None].astype(np.float32), cv2.INTER_LINEAR)[0].astype(float)

    places = np.arange(-REACH, REACH + STEP / 2.0, STEP)
    for axis in (0, 1):
        for row in range(1, cells - 1):
            for edge in range(1, cells):
                for along in ALONG:
                    points = np.empty((len(places), 2))
                    points[:, axis], points[:, 1 - axis] = edge + places, row + along
                    profile = sample(points)
                    offset = crossing(profile, places)
                    if offset is not None:
                        yield axis, edge, row + along, offset, 1.0 if profile[-1] > profile[0] else -1.0


def corners_by_cells(grey, corners, cells):
    """The corners that the edges between the cells give, beginning from others; `None` where the cells do not suffice."""
    square = np.array([[0, 0], [cells, 0], [cells, cells], [0, cells]], np.float32)
    to_image = cv2.getPerspectiveTransform(square, np.asarray(corners, np.float32))
    half = cells / 2.0

    def moved(axis, x, y):
        """A projection that is nearly none: a movement, a linear part, and the two terms of perspective."""
        if axis == 0:
            return [1.0, x, y, 0.0, 0.0, 0.0, x * x, x * y]
        return [0.0, 0.0, 0.0, 1.0, x, y, x * y, y * y]

    rows, offsets = [], []
    for axis, across, along, offset, sense in edges_between_cells(grey, to_image, cells):
        x, y = (across, along) if axis == 0 else (along, across)
        senses = [sense, 0.0] if axis == 0 else [0.0, sense]
        rows.append([*moved(axis, x - half, y - half), *senses])
        offsets.append(offset)
    if len(rows) < MIN_EDGES:
        return None
    rows, offsets, weights = np.array(rows), np.array(offsets), np.ones(len(rows))
    for _ in range(5):
        fit = np.linalg.lstsq(rows * weights[:, None], offsets * weights, rcond=None)[0]
        residual = np.abs(offsets - rows @ fit)
        deviation = 1.4826 * np.median(residual) + 1e-4
        weights = 1.0 / np.maximum(1.0, residual / (2.0 * deviation))
    if deviation > MAX_RESIDUAL_CELLS:
        return None
    points = [
        [x + np.dot(moved(0, x - half, y - half), fit[:8]), y + np.dot(moved(1, x - half, y - half), fit[:8]), 1.0]
        for x, y in square
    ]
    points = np.array(points) @ to_image.T
    return points[:, :2] / points[:, 2:]


def half_side(corners):
    return np.linalg.norm(corners - corners.mean(0), axis=1).mean() / math.sqrt(2.0)


def ours(command, family, images):
    run = [command, "detect", "--marker", f"{family}:*", "--format", "jsonl", *images]
    # An image that cannot be read is named there, and the others are looked at.
    lines = subprocess.run(run, stdout=subprocess.PIPE, text=True, check=False).stdout.splitlines()
    found = (json.loads(line) for line in lines if line.startswith("{"))
    return {line["image"]: line["detections"] for line in found if "detections" in line}


def main():
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    command, family, images = sys.argv[1], sys.argv[2], sys.argv[3:]
    cells = cells_of(family)
    others = [kind(family) for kind in (references.AprilTagFiltered, references.OpenCV) if kind.takes(family)]
    names = ["alight", *(other.name for other in others)]
    found = ours(command, family, images)
    distances, outward, without = collections.defaultdict(list), [], 0
    for image in images:
        grey = cv2.imread(image, references.AS_STORED)
        if grey is None or not found.get(image):
            continue
        seen = [found[image], *(other.detect(grey) for other in others)]
        for first in seen[0]:
            quad = np.array(first["corners_px"])
            side = np.linalg.norm(quad - np.roll(quad, -1, 0), axis=1).min()
            near = [
                [one for one in detections if one["id"] == first["id"]
                 and np.linalg.norm(np.mean(one["corners_px"], 0) - quad.mean(0)) < 0.25 * side]
                for detections in seen
            ]  # fmt: skip
            if not all(near) or side < MIN_CELL_PX * cells:
                continue
            quads = [same_order(quad, np.array(one[0]["corners_px"])) for one in near]
            # It begins from the mean of all, so that it favours no detector.
            true = corners_by_cells(grey, np.mean(quads, 0), cells)
            if true is None:
                without += 1
                continue
            distances[image].append([np.linalg.norm(one - true, axis=1).mean() for one in quads])
            outward.append([half_side(one) - half_side(true) for one in quads])
    if not distances:
        sys.exit(f"none of {len(images)} images has a {family} of at least {MIN_CELL_PX:.0f} px a cell that all of {names} find")
    markers = np.concatenate([np.array(of) for of in distances.values()])
    by_image = np.array([np.median(of, 0) for of in distances.values()])
    print(f"{len(markers)} markers in {len(by_image)} images; {without} more, whose cells do not suffice, are left out")
    print("distance of the corners from their positions by the cells, and how far outside of them they are; px")
    for i, name in enumerate(names):
        print(
            f"{name:20} median of markers {np.median(markers[:, i]):.2f}, of images {np.median(by_image[:, i]):.2f};"
            f" outside {statistics.median(row[i] for row in outward):+.2f}"
        )


if __name__ == "__main__":
    main()
