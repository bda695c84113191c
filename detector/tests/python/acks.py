"""Tests whether the example detector acknowledges JPEG frames as they arrive, also while it searches one."""

import pathlib
import sys
import threading
import types

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "examples" / "python"))
import detector  # noqa: E402  (exits with 77 without its libraries)


class Bytes:
    def __init__(self, data):
        self.data = data

    def to_bytes(self):
        return self.data


def frame(sequence):
    header = detector.Writer(detector.FRAME_HEADER).text("down").unsigned(sequence).signed(-sequence).text("clock")
    header.unsigned(0).unsigned(64).unsigned(48).unsigned(1).unsigned(0)
    return types.SimpleNamespace(attachment=Bytes(header.bytes()), payload=Bytes(b"no JPEG"))


class Session:
    """Stores the callback of the frames, and the published messages by key."""

    def __init__(self):
        self.on_frame, self.published, self.ready = None, {}, threading.Event()

    def declare_publisher(self, key, **_):
        published = self.published.setdefault(key, [])
        return types.SimpleNamespace(put=published.append)

    def declare_queryable(self, key, _):
        return key

    def declare_subscriber(self, key, callback):
        if key == "camera/down/jpeg":
            self.on_frame = callback
            self.ready.set()
        return key

    def get(self, *_, **__):
        return []

    def liveliness(self):
        return types.SimpleNamespace(declare_token=lambda key: key)

    def put(self, key, value):
        pass


searching, continues = threading.Event(), threading.Event()


def find(header, payload):
    searching.set()
    assert continues.wait(20)


session = Session()
marker = types.SimpleNamespace(text="aruco-4x4-50:7:0.15", find=find)
args = types.SimpleNamespace(id="python", camera="down", input="jpeg", place="ground", marker=marker)
under_test = detector.Detector(session, "", args)
running = threading.Thread(target=under_test.run, daemon=True)
running.start()
assert session.ready.wait(20)
session.on_frame(frame(1))
assert searching.wait(20)
for sequence in (2, 3):
    session.on_frame(frame(sequence))
acks = session.published["detector/python/ack"]
detections = session.published["detector/python/detections"]
before = (len(acks), len(detections))
continues.set()
under_test.stopped.set()
running.join(20)
assert before == (3, 0), f"acknowledgements and detections while the first frame is searched: {before}"
reader = detector.Reader(acks[2], detector.FRAME_ACK)
received = (reader.text(), reader.unsigned(), reader.signed(), reader.text(), reader.unsigned())
assert received == ("down", 3, -3, "clock", 7), received
