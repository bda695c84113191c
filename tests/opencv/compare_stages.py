#!/usr/bin/env python3
"""Compares each stage of the ring detector with OpenCV's function for it, on the same images.

    python3 tests/opencv/compare_stages.py [IMAGE ...]

Without images it renders three and takes some of the photographs next to the repository, if they are there. The
stages come from the example `stages` of the crate `fiducial`, which is built first. Exit status: 0 when the stages
agree within the limits below, 1 when not, 77 with a message when Python lacks a package.
"""

import json
import pathlib
import subprocess
import sys
import tempfile

try:
    import cv2
    import numpy as np
except ImportError as missing:
    print(f"skipped: this comparison needs Python with numpy and OpenCV ({missing})")
    sys.exit(77)

ROOT = pathlib.Path(__file__).resolve().parents[2]
PHOTOS = ROOT.parent / "shared" / "data" / "photos"

# OpenCV 5 rounds the filter's mean to the nearest integer in its scalar code and down in its vector code, so it is
# compared with the unrounded mean as well.
LIMITS = {
    "filter_off_mean": 0.51,
    "filter_off_opencv": 1,
    "threshold_different": 0,
    "contours_missing": 0,
    "area_difference": 1e-6,
    "centre_difference_px": 0.01,
    "axis_difference_px": 0.02,
}


def rendered(name):
    """The marker in 1296 x 972 pixels, drawn with OpenCV at eight times the size."""
    rng = np.random.default_rng(len(name))
    ground = cv2.resize(rng.normal(120, 30, (61, 81)), (1296, 972), interpolation=cv2.INTER_CUBIC)
    tilt = {"head-on": 1.0, "tilted": 0.8, "far": 0.95}[name]
    size = {"head-on": 300, "tilted": 400, "far": 45}[name]
    scale = 8
    side = int(size * 1.4)
    patch = np.full((side * scale, side * scale), 225, np.uint8)
    centre = side * scale // 2
    for radius, grey in [(50, 30), (40, 225), (25, 30), (15, 225), (3, 30), (1, 225)]:
        axis = radius / 100 * size * scale
        cv2.ellipse(patch, (centre, centre), (round(axis), round(axis * tilt)), 25, 0, 360, grey, -1)
    patch = cv2.resize(patch, (side, side), interpolation=cv2.INTER_AREA)
    top, left = 300, 500
    ground[top : top + side, left : left + side] = patch
    ground = cv2.GaussianBlur(ground, (0, 0), 0.6) + rng.normal(0, 2, ground.shape)
    return np.clip(np.rint(ground), 0, 255).astype(np.uint8)


def mean_of_13(grey):
    """Equations 3.1 and 3.2 without rounding."""
    height, width = grey.shape
    border = np.pad(grey.astype(np.float64), 2, mode="reflect")
    total, weight = np.zeros((height, width)), np.zeros((height, width))
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            if dx * dx + dy * dy <= 4:
                near = border[2 + dy : 2 + dy + height, 2 + dx : 2 + dx + width]
                w = np.exp(-(dx * dx + dy * dy + (near - grey) ** 2) / (2 * 175.0**2))
                total += w * near
                weight += w
    return total / weight


def angle_difference(a, b):
    difference = abs(a - b) % 180
    return min(difference, 180 - difference)


def compare(image, program, folder):
    subprocess.run([program, image, folder], check=True, stdout=subprocess.DEVNULL)
    read = lambda name: cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
    grey, filtered, binary = read("grey.png"), read("filtered.png"), read("binary.png")
    stages = json.loads((folder / "contours.json").read_text())

    reference = cv2.bilateralFilter(grey, 5, 175, 175)
    off_opencv = np.abs(filtered.astype(int) - reference)
    row = {
        "filter_off_mean": np.abs(filtered - mean_of_13(grey)).max(),
        "filter_off_opencv": off_opencv.max(),
        "filter_off_share": (off_opencv > 0).mean(),
    }

    # OpenCV's threshold asks for more than T, Equation 3.3 for at least T.
    _, reference = cv2.threshold(filtered, stages["threshold"] - 1, 255, cv2.THRESH_BINARY)
    row["threshold_different"] = int((reference != binary).sum())

    found, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    theirs = [tuple(map(tuple, c[:, 0, :].tolist())) for c in found]
    ours = [tuple(map(tuple, c["points"])) for c in stages["contours"]]
    row["contours"] = len(ours)
    # Equal as lists of points, start and direction included.
    row["contours_missing"] = len(set(theirs) ^ set(ours)) + abs(len(theirs) - len(ours))
    row["same_order"] = theirs == ours[::-1]

    worst = {"area": 0.0, "centre": 0.0, "axis": 0.0, "angle": 0.0}
    row["ellipses"] = row["ellipses_valid"] = 0
    for contour in stages["contours"]:
        points = np.array(contour["points"], np.int32).reshape(-1, 1, 2)
        worst["area"] = max(worst["area"], abs(cv2.contourArea(points) - contour["area"]))
        if contour["ellipse"] is None or len(points) < 5:
            continue
        row["ellipses"] += 1
        if not contour["valid"]:
            # The fit to another shape is arbitrary; only valid ellipses are compared.
            continue
        row["ellipses_valid"] += 1
        (x, y), (minor, major), angle = cv2.fitEllipse(points)
        ours = contour["ellipse"]
        worst["centre"] = max(worst["centre"], np.hypot(x - ours[0], y - ours[1]))
        worst["axis"] = max(worst["axis"], abs(minor - ours[2]), abs(major - ours[3]))
        if ours[2] < 0.98 * ours[3]:
            worst["angle"] = max(worst["angle"], angle_difference(angle, ours[4]))
    row["area_difference"] = worst["area"]
    row["centre_difference_px"] = worst["centre"]
    row["axis_difference_px"] = worst["axis"]
    row["angle_difference_deg"] = worst["angle"]
    return row


def images(arguments, folder):
    if arguments:
        return [pathlib.Path(a) for a in arguments]
    chosen = []
    for name in ["head-on", "tilted", "far"]:
        path = folder / f"{name}.png"
        cv2.imwrite(str(path), rendered(name))
        chosen.append(path)
    if not PHOTOS.is_dir():
        print("the photographs next to the repository are missing: renderings only")
        return chosen
    for pattern in ["negative_aerial/*/*", "negative_street/*/gtsdb*", "ring_*/*/*", "calibration/*/left0*", "stag/*/*"]:
        chosen += sorted(PHOTOS.glob(pattern))[:3]
    return chosen


def main():
    # With the features that the complete workspace requires of its dependencies, as `cargo test --workspace` has built it.
    build = ["cargo", "build", "-q", "--workspace", "--example", "stages", "--message-format=json"]
    built = subprocess.run(build, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    program = next(m["executable"] for m in map(json.loads, built.splitlines()) if m.get("executable"))
    print(f"OpenCV {cv2.__version__}")
    names = None
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        for image in images(sys.argv[1:], folder):
            row = compare(image, program, folder / "stages")
            if names is None:
                names = list(row)
                print("\t".join(["image"] + names))
            print("\t".join([image.name] + [f"{row[n]:.4g}" if isinstance(row[n], float) else str(row[n]) for n in names]))
            over = [n for n, limit in LIMITS.items() if row[n] > limit]
            if over:
                failed += 1
                print(f"  beyond the limits: {', '.join(over)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
