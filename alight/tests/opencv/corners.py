"""The corners that the detector in Python finds of a marker in a picture, as JSON.

    corners.py DETECTOR.PY MARKER PICTURE

Exit status 77 when a package is missing.
"""

import importlib.util
import json
import sys

spec = importlib.util.spec_from_file_location("detector", sys.argv[1])
detector = importlib.util.module_from_spec(spec)
spec.loader.exec_module(detector)

picture = detector.cv2.imread(sys.argv[3], detector.cv2.IMREAD_GRAYSCALE)
height, width = picture.shape
header = {"format": 0, "width": width, "height": height}
corners = detector.Marker(sys.argv[2]).find(header, picture.tobytes())
print(json.dumps(None if corners is None else corners.tolist()))
