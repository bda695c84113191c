"""Reads H.264 over RTP as a program without any part of Alight: rtp.py PORT PICTURES

Each picture has its number in its pixels: sixteen squares in its upper left corner, the lowest bit first, white for 1. Prints
the result as JSON on its last line. Exit status: 0 all was as it must be, 1 it was not, 77 no OpenCV with a reader of videos.
"""

import json
import os
import sys
import tempfile
import time

# ffmpeg's messages on damaged pictures go to the error output, and are counted there.
os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = "protocol_whitelist;file,rtp,udp|fflags;nobuffer|flags;low_delay"
os.environ["OPENCV_FFMPEG_LOGLEVEL"] = "16"

try:
    import cv2
except ImportError as problem:
    print(f"no package opencv: {problem}")
    sys.exit(77)

BITS, SQUARE = 16, 32

port, pictures = int(sys.argv[1]), int(sys.argv[2])
with tempfile.TemporaryDirectory() as folder:
    name = os.path.join(folder, "alight.sdp")
    with open(name, "w") as file:
        file.write("v=0\no=- 0 0 IN IP4 127.0.0.1\ns=Alight\nc=IN IP4 127.0.0.1\nt=0 0\n")
        file.write(f"m=video {port} RTP/AVP 96\na=rtpmap:96 H264/90000\na=fmtp:96 packetization-mode=1\n")
    # Errors of the decoder go to a file, through the descriptor that the library writes to.
    log = open(os.path.join(folder, "log"), "w+")
    kept = os.dup(2)
    os.dup2(log.fileno(), 2)
    print("listening", flush=True)
    began = time.monotonic()
    video = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
    opened = video.isOpened()
    first_s = time.monotonic() - began
    numbers = []
    while opened and len(numbers) < pictures:
        is_read, picture = video.read()
        if not is_read:
            break
        grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        squares = [grey[8 : SQUARE - 8, bit * SQUARE + 8 : (bit + 1) * SQUARE - 8].mean() for bit in range(BITS)]
        numbers.append(sum(int(square > 128) << bit for bit, square in enumerate(squares)))
        height, width = grey.shape
    os.dup2(kept, 2)
    log.flush()
    log.seek(0)
    said = log.read()
assert opened, f"OpenCV does not open it: {said}"
steps = [after - before for before, after in zip(numbers, numbers[1:])]
result = {
    "pictures": len(numbers),
    "size": [width, height],
    "first_s": round(first_s, 2),
    "steps_of_1": steps.count(1),
    "smallest_step": min(steps),
    "said": said,
}
print(json.dumps(result))
sys.exit(0 if len(numbers) == pictures and min(steps) > 0 and not said else 1)
