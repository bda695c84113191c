"""Reads the video of a landing's page as a program with only Motion JPEG: mjpeg.py URL

Prints the result as JSON on its last line. Exit status 77: no OpenCV with a reader of videos.
"""

import json
import sys

try:
    import cv2
except ImportError as problem:
    print(f"no package opencv: {problem}")
    sys.exit(77)

PICTURES = 30

video = cv2.VideoCapture(sys.argv[1], cv2.CAP_FFMPEG)
assert video.isOpened(), "OpenCV does not open it"
pictures = []
while len(pictures) < PICTURES:
    is_read, picture = video.read()
    assert is_read, f"the video ends after {len(pictures)} pictures"
    pictures.append(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
changes = sum(float(cv2.absdiff(a, b).mean()) > 0.1 for a, b in zip(pictures, pictures[1:]))
height, width = pictures[0].shape
spread = int(pictures[-1].max()) - int(pictures[-1].min())
print(json.dumps({"pictures": len(pictures), "changes": changes, "size": [width, height], "spread": spread}))
