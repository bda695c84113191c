#!/usr/bin/env python3
"""A camera in Python: publishes a picture again and again as Alight's frames, with calibration and mount.

Put your camera in the place of `pictures`. docs/wire-format.md explains every byte.

    python3 camera-pub/examples/python/camera.py --picture marker.pgm --focal-px 1000

It connects to a service of Alight that runs (`alight detector`, `alight land`): start that first. A picture as PGM:
`ffmpeg -i marker.png -pix_fmt gray marker.pgm`. Needed: pip install eclipse-zenoh. Exit status 77 when it is missing.
"""

import argparse
import json
import os
import signal
import struct
import sys
import threading
import time

try:
    import zenoh
except ImportError as missing:
    print(f"skipped: {missing.name} is missing (pip install eclipse-zenoh)")
    sys.exit(77)

# Types and versions of the messages (docs/wire-format.md).
FRAME_HEADER, CAMERA_INFO = (1, 3), (2, 1)
MONO8, PINHOLE = 0, 0
# A camera that looks down, the upper edge of its image to the vehicle's nose: w, x, y, z.
LOOKS_DOWN = (0.5**0.5, 0.0, 0.0, 0.5**0.5)


def clock_name():
    """The name of this machine's monotonic clock: stamps of other clocks are refused."""
    with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as boot:
        return f"monotonic/{boot.read()[:8]}"


def unsigned(value):
    encoded = bytearray()
    while value >= 0x80:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


def signed(value):
    return unsigned((value << 1) ^ (value >> 63))


def text(value):
    return unsigned(len(value.encode())) + value.encode()


def doubles(*values):
    return struct.pack(f"<{len(values)}d", *values)


def message(kind, *fields):
    return b"A" + bytes(kind) + b"".join(fields)


def frame_header(camera, sequence, stamp_ns, size):
    exposure_ns, parts = 0, 0
    return message(
        FRAME_HEADER, text(camera), unsigned(sequence), signed(stamp_ns), text(clock_name()), unsigned(exposure_ns),
        unsigned(size[0]), unsigned(size[1]), unsigned(MONO8), unsigned(parts),
    )


def camera_info(camera, size, focal_px):
    # The centre of the top-left pixel is (0, 0).
    centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    position_m = (0.0, 0.0, 0.0)
    return message(
        CAMERA_INFO, text(camera), unsigned(size[0]), unsigned(size[1]), b"\1", doubles(focal_px, focal_px),
        doubles(*centre), unsigned(PINHOLE), doubles(*position_m), doubles(*LOOKS_DOWN),
    )


def read_pgm(path):
    """Width, height and grey pixels of a binary PGM file."""
    try:
        with open(path, "rb") as file:
            data = file.read()
    except OSError as problem:
        sys.exit(f"the picture cannot be read: {problem}")
    words, at = [], 0
    while len(words) < 4:
        end = at
        while data[end : end + 1].strip():
            end += 1
        words += [data[at:end]] if end > at else []
        at = end + 1
    if words[0] != b"P5" or int(words[3]) > 255:
        raise SystemExit(f"{path} is not a PGM file with one byte per pixel")
    width, height = int(words[1]), int(words[2])
    return width, height, data[at : at + width * height]


def pictures(args, stopped):
    """Mid-exposure in nanoseconds of the monotonic clock, and the pixels row by row: here always the same ones."""
    _, _, pixels = read_pgm(args.picture)
    while not stopped.wait(1.0 / args.rate_hz):
        yield time.monotonic_ns(), pixels


def publish(session, prefix, args, stopped):
    size = read_pgm(args.picture)[:2]
    info, key = camera_info(args.id, size, args.focal_px), f"{prefix}camera/{args.id}/info"
    rare = {"priority": zenoh.Priority.INTERACTIVE_HIGH, "congestion_control": zenoh.CongestionControl.DROP}
    # A late frame is of no use: this one drops whole frames, and keeps the rest.
    newest = getattr(zenoh.CongestionControl, "BLOCK_FIRST", zenoh.CongestionControl.DROP)
    infos = session.declare_publisher(key, **rare)
    frames = session.declare_publisher(
        f"{prefix}camera/{args.id}/frame", priority=zenoh.Priority.DATA_LOW, congestion_control=newest
    )
    kept = [
        session.declare_queryable(key, lambda query: query.reply(key, info)),
        session.liveliness().declare_token(f"{prefix}alive/camera-pub/{args.id}"),
    ]
    published_s = 0.0
    for sequence, (stamp_ns, pixels) in enumerate(pictures(args, stopped)):
        if time.monotonic() - published_s > 1.0:
            published_s = time.monotonic()
            infos.put(info)
        frames.put(pixels, attachment=frame_header(args.id, sequence, stamp_ns, size))
    return kept


def configuration(args):
    """The session's configuration, and the prefix of its keys."""
    if args.zenoh:
        # A file of the project: a peer like all others, whose keys get the vehicle's name from `namespace`.
        return zenoh.Config.from_file(args.zenoh), ""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([args.connect]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config, args.vehicle + "/"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    port = os.environ.get("ALIGHT_MEET", "7447")
    file = os.environ.get("ALIGHT_ZENOH", "")
    parser.add_argument("--id", default="down")
    parser.add_argument("--picture", required=True, help="a PGM file")
    parser.add_argument("--focal-px", type=float, required=True)
    parser.add_argument("--rate-hz", type=float, default=15.0)
    parser.add_argument("--zenoh", default=file if os.path.isfile(file) else "", help="a Zenoh configuration (JSON5)")
    parser.add_argument("--connect", default=f"tcp/127.0.0.1:{port}", help="the rendezvous, without --zenoh")
    parser.add_argument("--vehicle", default=os.environ.get("ALIGHT_VEHICLE", "drone"))
    args = parser.parse_args()
    config, prefix = configuration(args)
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    try:
        session = zenoh.open(config)
    except zenoh.ZError as problem:
        sys.exit(f"no service of Alight is there: start one first, as `alight land` or `alight detector` ({problem})")
    with session:
        print(f"Ready: {args.id}", file=sys.stderr, flush=True)
        publish(session, prefix, args, stopped)
    return 0


if __name__ == "__main__":
    sys.exit(main())
