"""Calibrates with OpenCV from the points in a JSON file, and prints the result as JSON."""

import json
import sys
import time

try:
    import cv2
    import numpy
except ImportError as problem:
    print(problem)
    sys.exit(77)

with open(sys.argv[1], encoding="utf-8") as file:
    task = json.load(file)
size = (task["width"], task["height"])
places = [numpy.array([[x, y, 0.0] for x, y, _, _ in view]) for view in task["views"]]
seen = [numpy.array([[u, v] for _, _, u, v in view]) for view in task["views"]]
settled = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
begin = time.perf_counter()
try:
    if task["lens"] == "fisheye":
        # OpenCV 5 has moved these names.
        names = cv2 if hasattr(cv2, "CALIB_FIX_SKEW") else cv2.fisheye
        flags = names.CALIB_RECOMPUTE_EXTRINSIC | names.CALIB_FIX_SKEW
        rms, camera, lens, _, _ = cv2.fisheye.calibrate(
            [p.reshape(1, -1, 3) for p in places],
            [s.reshape(1, -1, 2) for s in seen],
            size,
            None,
            None,
            flags=flags,
            criteria=settled,
        )
    else:
        flags = {"4": cv2.CALIB_FIX_K3, "5": 0, "8": cv2.CALIB_RATIONAL_MODEL}[task["lens"]]
        places = [p.astype(numpy.float32) for p in places]
        seen = [s.astype(numpy.float32) for s in seen]
        rms, camera, lens, _, _ = cv2.calibrateCamera(
            places, seen, size, None, None, flags=flags, criteria=settled
        )
except cv2.error as problem:
    print(json.dumps({"problem": str(problem).strip().splitlines()[-1]}))
    sys.exit(0)
print(
    json.dumps(
        {
            "rms_px": rms,
            "seconds": time.perf_counter() - begin,
            "camera": [camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2]],
            "lens": [float(k) for k in lens.ravel()],
        }
    )
)
