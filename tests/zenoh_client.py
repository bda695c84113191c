#!/usr/bin/env python3
"""An independent Zenoh program: which services are there, and what do the frames' headers contain?

It lists the live services by their liveliness tokens and reads the headers of some frames from their attachments
(codec: `A`, type 1, version 3, then postcard), and prints the result as one JSON object on the last line.

    python3 tests/zenoh_client.py tcp/127.0.0.1:7447

Exit status: 0 services and frames were seen, 1 they were not, 77 eclipse-zenoh is missing (pip install eclipse-zenoh).
"""

import json
import sys
import threading

try:
    import zenoh
except ImportError:
    print("skipped: eclipse-zenoh is missing (pip install eclipse-zenoh)")
    sys.exit(77)

FRAMES = 5
PATIENCE_S = 30
NEEDED = {"simulator", "detector", "controller"}


class Header:
    """Reads postcard: variable-length integers (zigzag when signed), strings with their length in front."""

    def __init__(self, data):
        if data[:3] != b"A\x01\x03":
            raise ValueError(f"not a frame header of version 3: {data[:3]!r}")
        self.data, self.at = data, 3

    def unsigned(self):
        value, shift = 0, 0
        while True:
            byte = self.data[self.at]
            self.at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    def signed(self):
        value = self.unsigned()
        return (value >> 1) ^ -(value & 1)

    def text(self):
        length = self.unsigned()
        self.at += length
        return self.data[self.at - length : self.at].decode()

    def read(self):
        header = {
            "camera": self.text(),
            "sequence": self.unsigned(),
            "stamp_ns": self.signed(),
            "clock": self.text(),
            "exposure_ns": self.unsigned(),
            "width": self.unsigned(),
            "height": self.unsigned(),
            "format": ("mono8", "jpeg")[self.unsigned()],
        }
        names = ("x", "y", "width", "height", "scale", "bytes")
        parts = self.unsigned()
        header["parts"] = [{name: self.unsigned() for name in names} for _ in range(parts)]
        if self.at != len(self.data):
            raise ValueError("bytes after the end of the header")
        return header


def main(endpoint):
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    frames, problems, done = [], [], threading.Event()

    def take(sample):
        try:
            header = Header(sample.attachment.to_bytes()).read()
            header["payload_bytes"] = len(sample.payload)
            frames.append(header)
        except (ValueError, IndexError, AttributeError) as problem:
            problems.append(str(problem))
        if len(frames) + len(problems) >= FRAMES:
            done.set()

    with zenoh.open(config) as session:
        replies = session.liveliness().get("drone/alive/**", timeout=5.0)
        alive = sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)
        subscriber = session.declare_subscriber("drone/camera/*/frame", take)
        done.wait(PATIENCE_S)
        subscriber.undeclare()
    services = {key.split("/")[2] for key in alive}
    sequences = [frame["sequence"] for frame in frames]
    good = (
        NEEDED <= services
        and len(frames) >= FRAMES
        and not problems
        and sequences == sorted(set(sequences))
        and all(f["payload_bytes"] == f["width"] * f["height"] for f in frames)
    )
    print(json.dumps({"good": good, "alive": alive, "frames": frames[:2], "problems": problems}))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"))
