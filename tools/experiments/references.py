#!/usr/bin/env python3
"""Runs the reference detectors over the rendered sets and the labelled photographs.

    python3 tools/experiments/references.py SETS RESULTS [set=NAME ...] [family=NAME ...] [detector=NAME ...] [photographs=FOLDER]

SETS are the frames that `alight experiment markers` has rendered, RESULTS is the folder of its answers; the references' answers are
put next to them in the same form, and the same command with `--replace` scores them with its own. Sets that are not
rendered are left out. Everything runs on one thread,
and times are processor time. Detectors that are not installed are skipped with a message: OpenCV
(opencv-contrib-python or opencv-python), AprilTag 3 (pyapriltags or pupil-apriltags), STag (stag-python). The thesis'
rings are rebuilt from its Algorithms 1 to 15 on OpenCV.

Pixels are OpenCV's: (0, 0) is the centre of the first pixel. AprilTag's corners, which count from the corner of the
first pixel, are moved by half a pixel.
"""

import itertools
import json
import math
import pathlib
import re
import sys
import time

try:
    import cv2
    import numpy as np
except ImportError as missing:
    print(f"skipped: the reference detectors need Python with numpy and OpenCV ({missing})")
    sys.exit(0)
try:
    import pyapriltags as apriltags
except ImportError:
    try:
        import pupil_apriltags as apriltags
    except ImportError:
        apriltags = None
        print("skipped: AprilTag is not installed (pyapriltags)")
try:
    import stag
except ImportError:
    stag = None
    print("skipped: STag is not installed (stag-python)")

cv2.setNumThreads(1)

SETS = [
    "textured", "adverse", "landing", "far", "tilt", "blur", "noise", "light", "rolling", "shade", "ground", "cut", "tracking", "negatives", "circles",
    "positions",
]  # fmt: skip
# Families of the labelled photographs: OpenCV's names and ours, labels may have either.
LABELS = {
    "tag36h11": "apriltag-36h11",
    "aruco_4x4_1000": "aruco-4x4-1000",
    "aruco_5x5_1000": "aruco-5x5-1000",
    "aruco_6x6_1000": "aruco-6x6-1000",
    "stag_hd21": "stag-hd21",
}
# As Alight reads them: as they are stored, without the rotation in Exif data.
AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
# Sets whose times are compared, and how often their frames are searched.
TIMED, TIMED_RUNS = ("textured", "tracking"), 5


def found(family, number, centre, corners=None, confidence=0.0, place=None):
    return {
        "family": family,
        "id": number,
        "centre_px": [float(c) for c in centre],
        "corners_px": None if corners is None else [[float(c) for c in corner] for corner in corners],
        "translation_m": place,
        "confidence": float(confidence),
    }


def crossing(corners):
    """The intersection of the diagonals: the projection of the centre."""
    a, b, c, d = (np.append(corner, 1.0) for corner in np.asarray(corners, float))
    meeting = np.cross(np.cross(a, c), np.cross(b, d))
    return meeting[:2] / meeting[2]


class OpenCV:
    """OpenCV's ArUco detector with sub-pixel corners."""

    name = "opencv"

    def __init__(self, family):
        kind, *rest = family.split("-")
        if kind == "aruco":
            dictionary = "DICT_" + "_".join(part.upper() for part in rest)
        else:
            dictionary = "DICT_APRILTAG_" + rest[0]
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
        self.detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        self.family = family

    @staticmethod
    def takes(family):
        return family.startswith("aruco") or family in ("apriltag-16h5", "apriltag-36h11")

    def detect(self, grey):
        corners, ids, _ = self.detector.detectMarkers(grey)
        ids = [] if ids is None else ids.ravel()
        quads = [c.reshape(4, 2) for c in corners]
        return [found(self.family, int(i), crossing(quad), quad) for i, quad in zip(ids, quads)]


class AprilTag:
    """The AprilTag library at full resolution."""

    name, decimate, is_filtered = "apriltag", 1.0, False

    def __init__(self, family):
        name = "tag" + family.split("-")[1]
        self.detector = apriltags.Detector(families=name, nthreads=1, quad_decimate=self.decimate)
        self.family = family

    @staticmethod
    def takes(family):
        return apriltags is not None and family in ("apriltag-16h5", "apriltag-36h11", "apriltag-25h9")

    def detect(self, grey):
        tags = self.detector.detect(grey)
        if self.is_filtered:
            tags = [tag for tag in tags if tag.hamming == 0 and tag.decision_margin >= 5.0]
        # From the bottom left counter-clockwise to the top left clockwise.
        return [
            found(self.family, tag.tag_id, tag.center - 0.5, tag.corners[::-1] - 0.5, tag.decision_margin)
            for tag in tags
        ]


class AprilTagFiltered(AprilTag):
    """The same without uncertain detections."""

    name, is_filtered = "apriltag-filtered", True


class AprilTagHalf(AprilTag):
    """The same at half the resolution."""

    name, decimate, is_filtered = "apriltag-half", 2.0, True


class Stag:
    """The authors' STag library."""

    name = "stag"

    def __init__(self, family):
        self.distance = int(family.removeprefix("stag-hd"))
        self.family = family

    @staticmethod
    def takes(family):
        return stag is not None and family.startswith("stag")

    def detect(self, grey):
        corners, ids, _ = stag.detectMarkers(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), self.distance)
        quads = [np.asarray(c, float).reshape(4, 2) for c in corners]
        return [found(self.family, int(np.ravel(i)[0]), crossing(q), q) for i, q in zip(ids, quads)]


class Rings:
    """The thesis' rings (Algorithms 1 to 15) on OpenCV."""

    name, threshold, with_orientation = "thesis-rings", 70, True
    # Inner radius by outer, and the outer radius by the marker's diameter.
    KINDS = ((40 / 50, 50 / 100), (15 / 25, 25 / 100), (1 / 3, 3 / 100))

    def __init__(self, family):
        self.family = family

    @staticmethod
    def takes(family):
        return family == "rings"

    def detect(self, grey):
        filtered = cv2.bilateralFilter(grey, 5, 175, 175)
        # The thesis' T is the least that is white, OpenCV's the most that is black.
        _, binary = cv2.threshold(filtered, self.threshold - 1, 255, cv2.THRESH_BINARY)
        contours, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
        ellipses = []
        for contour in contours:
            if len(contour) > 4:
                centre, (minor, major), angle = cv2.fitEllipse(contour)
                area = math.pi / 4.0 * minor * major
                if minor > 0 and 0.95 * area <= cv2.contourArea(contour) <= 1.05 * area:
                    ellipses.append((centre, minor, major, math.radians(angle), contour))
        least, most, _, _ = cv2.minMaxLoc(grey)
        black = 0.3 * (most - least) + least
        rings = []
        if ellipses:
            # All pairs of near centres, without asking Python for each.
            centres = np.array([ellipse[0] for ellipse in ellipses])
            near = np.hypot(*(centres[:, None] - centres[None]).T) <= 10.0
            for i, j in np.argwhere(np.triu(near, 1)):
                rings.append(self.ring(grey, black, ellipses[i], ellipses[j]))
            rings = [ring for ring in rings if ring is not None]
        matched = self.matched(rings)
        if not matched:
            return []
        centre = np.mean([ring["centre"] for ring in matched], axis=0)
        largest = max(matched, key=lambda ring: ring["major"])
        size = largest["major"] / (2.0 * self.KINDS[largest["kind"]][1])
        return [found(self.family, None, centre, None, len(matched) / 3.0, [0.0, 0.0, size])]

    def is_turned(self, a, b):
        return self.with_orientation and abs(math.atan2(math.sin(a - b), math.cos(a - b))) > math.radians(20.0)

    def ring(self, grey, black, a, b):
        (first, second) = (a, b) if a[2] < b[2] else (b, a)
        eccentricity = [math.sqrt(max(0.0, 1.0 - (e[1] / e[2]) ** 2)) for e in (first, second)]
        if abs(eccentricity[0] - eccentricity[1]) > 0.2 or self.is_turned(first[3], second[3]):
            return None
        ratios = [min(first[k], second[k]) / max(first[k], second[k]) for k in (1, 2)]
        kinds = [k for k, (ratio, _) in enumerate(self.KINDS) if all(abs(r - ratio) < 0.1 for r in ratios)]
        if not kinds:
            return None
        x, y, width, height = cv2.boundingRect(second[4])
        mask = np.zeros((height, width), np.uint8)
        cv2.drawContours(mask, [second[4]], -1, 255, cv2.FILLED, offset=(-x, -y))
        cv2.drawContours(mask, [first[4]], -1, 0, cv2.FILLED, offset=(-x, -y))
        inside = grey[y : y + height, x : x + width][mask > 0]
        if len(inside) == 0 or np.mean(inside < black) <= 0.8:
            return None
        centre = np.mean([first[0], second[0]], axis=0)
        return {"kind": kinds[0], "centre": centre, "angle": (first[3] + second[3]) / 2.0, "major": second[2]}

    def matched(self, rings):
        def two(pair):
            kinds = [ring["kind"] for ring in pair]
            near = math.dist(pair[0]["centre"], pair[1]["centre"]) <= 10.0
            return 1 in kinds and kinds[0] != kinds[1] and near and not self.is_turned(pair[0]["angle"], pair[1]["angle"])

        def three(trio):
            pairs = list(itertools.combinations(trio, 2))
            kinds = {ring["kind"] for ring in trio}
            near = all(math.dist(a["centre"], b["centre"]) <= 10.0 for a, b in pairs)
            return len(kinds) == 3 and near and not any(self.is_turned(a["angle"], b["angle"]) for a, b in pairs)

        if len(rings) == 1:
            return rings
        if len(rings) == 2:
            return rings if two(rings) else None
        if len(rings) == 3:
            return rings if three(rings) else None
        pairs = (pair for pair in itertools.combinations(rings, 2) if two(pair))
        trios = (trio for trio in itertools.combinations(rings, 3) if three(trio))
        return next(pairs, None) or next(trios, None)


class RingsWaived(Rings):
    """The same without the test of orientations, which are noise in near-circles."""

    name, threshold, with_orientation = "thesis-rings-mended", 60, False


DETECTORS = [OpenCV, AprilTag, AprilTagFiltered, AprilTagHalf, Stag, Rings, RingsWaived]


def place(seen, frame):
    """Its position in the camera frame, by OpenCV from the corners, or from the size alone."""
    marker, camera = frame["marker"], frame["camera"]
    if marker is None:
        return None
    matrix = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]], float)
    distortion = np.array(camera["distortion"] or [0.0] * 4)
    if seen["corners_px"] is None:
        size_px = seen["translation_m"][2] if seen["translation_m"] else None
        return size_px and [0.0, 0.0, camera["fx"] * marker["size_m"] / size_px]
    half = marker["size_m"] / 2.0
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    corners = np.array(seen["corners_px"]).reshape(4, 1, 2)
    solved, _, translation = cv2.solvePnP(square, corners, matrix, distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    return [float(t) for t in translation.ravel()] if solved else None


def answer(detector, grey, runs):
    shortest = math.inf
    for _ in range(runs):
        start = time.process_time()
        seen = detector.detect(grey)
        shortest = min(shortest, time.process_time() - start)
    return 1e3 * shortest, seen


def write(path, lines):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def run_set(folder, results, name, family, detector):
    frames = [json.loads(line) for line in (folder / "truth.jsonl").read_text().splitlines()]
    lines = []
    for frame in frames:
        grey = cv2.imread(str(folder / frame["image"]), cv2.IMREAD_GRAYSCALE)
        ms, seen = answer(detector, grey, TIMED_RUNS if name in TIMED else 1)
        for marker in seen:
            marker["translation_m"] = place(marker, frame)
        lines.append({"image": frame["image"], "ms": ms, "found": seen})
    write(results / detector.name / name / f"{family}.jsonl", lines)
    total = sum(any(marker["family"] == family for marker in line["found"]) for line in lines)
    print(f"{name} {family} {detector.name}: something in {total} of {len(lines)} frames", flush=True)


def is_of(name, label, family):
    """Whether a label is of a family. An ArUco dictionary of 50, 100 or 250 markers is the beginning of that of 1000 markers."""
    stem = re.fullmatch("(aruco.*[-_])(50|100|250)", name)
    return name in (label, family) or (stem is not None and stem[1] + "1000" in (label, family))


def run_photographs(photographs, results, wanted):
    labels = [json.loads(line) for line in (photographs / "labels.jsonl").read_text().splitlines()]
    for label, family in LABELS.items():
        for kind in DETECTORS:
            if not kind.takes(family) or (wanted["detector"] and kind.name not in wanted["detector"]):
                continue
            detector, lines = kind(family), []
            for photograph in labels:
                if any(is_of(marker["family"], label, family) for marker in photograph["markers"]):
                    grey = cv2.imread(str(photographs / photograph["image"]), AS_STORED)
                    ms, seen = answer(detector, grey, 1)
                    lines.append({"image": photograph["image"], "ms": ms, "found": seen})
            if not lines:
                continue
            write(results / kind.name / "photographs" / f"{family}.jsonl", lines)
            print(f"photographs {family} {kind.name}: {len(lines)}", flush=True)


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    sets, results = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
    wanted = {"set": [], "family": [], "detector": [], "photographs": []}
    for argument in sys.argv[3:]:
        key, _, value = argument.partition("=")
        wanted[key].append(value)
    for name in wanted["set"] or (SETS if not wanted["photographs"] else []):
        folders = sorted(folder for folder in (sets / name).glob("*/") if (folder / "truth.jsonl").is_file())
        families = {folder.name: folder for folder in folders}
        if name in ("negatives", "circles") and (sets / name / "truth.jsonl").is_file():
            kinds = ("rings", "apriltag-16h5", "aruco-4x4-50", "stag-hd23", "apriltag-36h11")
            families = {family: sets / name for family in kinds}
        if wanted["set"] and not families:
            sys.exit(f"{sets / name} has no frames: `alight experiment markers --set {name}` renders them")
        for family, folder in families.items():
            if wanted["family"] and family not in wanted["family"]:
                continue
            for kind in DETECTORS:
                if kind.takes(family) and (not wanted["detector"] or kind.name in wanted["detector"]):
                    run_set(folder, results, name, family, kind(family))
    for folder in wanted["photographs"]:
        run_photographs(pathlib.Path(folder), results, wanted)


if __name__ == "__main__":
    main()
