#!/usr/bin/env python3
"""A detector in Python: OpenCV's ArUco and AprilTag on Alight's frames, a full member of the network.

It takes the newest frame of a camera (pixels as they are, or JPEG), publishes its detections with the frame's header
unchanged, sends its information, declares its presence, and answers commands. docs/wire-format.md explains every byte.

    python3 detector/examples/python/detector.py --id python --marker aruco-4x4-50:7:0.15
    alight detectors                         # it is listed, in shadow
    alight detectors use python              # it steers

    alight swap --to 'python3 detector/examples/python/detector.py --id python --marker aruco-4x4-50:7:0.15'

It connects to a service of Alight that runs: start that first. On the ground, `--zenoh ground` with the variables ALIGHT_CONNECT and
ALIGHT_KEYS joins the vehicle's network as Alight's own programs do (`alight config --session` writes the configuration).
Needed: pip install eclipse-zenoh numpy opencv-python-headless. Exit status 77 when one of them is missing.
"""

import argparse
import json
import os
import platform
import signal
import struct
import subprocess
import sys
import threading
import time

try:
    import cv2
    import numpy as np
    import zenoh
except ImportError as missing:
    print(f"skipped: {missing.name} is missing (pip install eclipse-zenoh numpy opencv-python-headless)")
    sys.exit(77)

# Types and versions of the messages (docs/wire-format.md).
FRAME_HEADER, CAMERA_INFO, DETECTIONS = (1, 3), (2, 1), (3, 3)
COMMAND_REPLY, DETECTOR_COMMAND, DETECTOR_INFO, FRAME_ACK = (9, 1), (13, 2), (15, 1), (16, 1)
CORNER_NOISE_PX = 0.3


class Reader:
    """Reads a message: the letter A, its type, its version, then postcard."""

    def __init__(self, data, kind):
        if data[:3] != bytes([ord("A"), *kind]):
            raise ValueError(f"type and version {kind} expected, found {tuple(data[1:3])}")
        self.data, self.at = data, 3

    def take(self, length):
        if self.at + length > len(self.data):
            raise ValueError("cut short")
        self.at += length
        return self.data[self.at - length : self.at]

    def unsigned(self):
        value, shift = 0, 0
        while True:
            byte = self.take(1)[0]
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    def signed(self):
        value = self.unsigned()
        return (value >> 1) ^ -(value & 1)

    def text(self):
        return self.take(self.unsigned()).decode()

    def doubles(self, count):
        return struct.unpack(f"<{count}d", self.take(8 * count))


class Writer:
    """Writes a message."""

    def __init__(self, kind):
        self.data = bytearray([ord("A"), *kind])

    def unsigned(self, value):
        while value >= 0x80:
            self.data.append(value & 0x7F | 0x80)
            value >>= 7
        self.data.append(value)
        return self

    def signed(self, value):
        return self.unsigned((value << 1) ^ (value >> 63))

    def text(self, text):
        encoded = text.encode()
        self.unsigned(len(encoded))
        self.data += encoded
        return self

    def texts(self, texts):
        self.unsigned(len(texts))
        for text in texts:
            self.text(text)
        return self

    def doubles(self, values):
        self.data += struct.pack(f"<{len(values)}d", *values)
        return self

    def floats(self, values):
        self.data += struct.pack(f"<{len(values)}f", *values)
        return self

    def byte(self, value):
        self.data.append(value)
        return self

    def bytes(self):
        return bytes(self.data)


def read_header(data):
    reader = Reader(data, FRAME_HEADER)
    header = {
        "camera": reader.text(),
        "sequence": reader.unsigned(),
        "stamp_ns": reader.signed(),
        "clock": reader.text(),
        "exposure_ns": reader.unsigned(),
        "width": reader.unsigned(),
        "height": reader.unsigned(),
        "format": reader.unsigned(),
    }
    if header["format"] not in (0, 1):
        raise ValueError("neither Mono8 nor JPEG")
    names = ("x", "y", "width", "height", "scale", "bytes")
    header["parts"] = [{name: reader.unsigned() for name in names} for _ in range(reader.unsigned())]
    # It is returned unchanged.
    header["encoded"] = data[3:]
    return header


def read_camera(data):
    reader = Reader(data, CAMERA_INFO)
    reader.text()
    width, height = reader.unsigned(), reader.unsigned()
    focal = reader.doubles(2) if reader.unsigned() else None
    centre = reader.doubles(2)
    lens = reader.unsigned()
    if focal is None or lens == 2:
        return None
    distortion = np.array(reader.doubles(8)) if lens == 1 else np.zeros(5)
    matrix = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1.0]])
    return {"size": (width, height), "matrix": matrix, "distortion": distortion}


def grey_parts(header, payload):
    """The pictures in a frame's payload, finest first, each with the offset and scale of its pixels in the frame."""
    if header["format"] == 0:
        pixels = np.frombuffer(payload, np.uint8).reshape(header["height"], header["width"])
        yield pixels, 0.0, 0.0, 1.0
        return
    whole = {"x": 0, "y": 0, "scale": 1, "bytes": len(payload)}
    at = 0
    for part in header["parts"] or [whole]:
        file = np.frombuffer(payload[at : at + part["bytes"]], np.uint8)
        at += part["bytes"]
        pixels = cv2.imdecode(file, cv2.IMREAD_GRAYSCALE)
        if pixels is not None:
            inset = (part["scale"] - 1) / 2
            yield pixels, part["x"] + inset, part["y"] + inset, float(part["scale"])


class Marker:
    """FAMILY:ID:SIZE_M."""

    def __init__(self, text):
        family, number, size = text.split(":")
        name = "DICT_" + family.removeprefix("aruco-").replace("-", "_").upper()
        dictionary = getattr(cv2.aruco, name, None)
        if dictionary is None:
            raise argparse.ArgumentTypeError(f"OpenCV has no family `{family}`")
        self.text, self.family, self.id, self.size_m = text, family, int(number), float(size)
        # OpenCV turns AprilTags by half a turn against AprilTag 3, and begins with their bottom-right corner.
        self.first_corner = 2 if family.startswith("apriltag-") else 0
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        # The default of 3 % of the frame's width is 39 pixels.
        parameters.minMarkerPerimeterRate = 0.01
        self.detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary), parameters)
        half = self.size_m / 2
        # The marker frame: x right, y up, z out of the face; its own top-left corner first, then clockwise.
        self.corners_m = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])

    def find(self, header, payload):
        """The marker's corners in the frame's pixels, its own top-left first, or None."""
        for pixels, left, top, scale in grey_parts(header, payload):
            corners, ids, _ = self.detector.detectMarkers(pixels)
            for found, number in zip(corners, [] if ids is None else ids.ravel()):
                if number == self.id:
                    corners = np.roll(found.reshape(4, 2), self.first_corner, axis=0)
                    return corners.astype(float) * scale + (left, top)
        return None

    def poses(self, corners, camera):
        """The two poses that a flat marker allows, the better first: rotation vector, translation, error in px."""
        count, turns, places, errors = cv2.solvePnPGeneric(
            self.corners_m, corners, camera["matrix"], camera["distortion"], flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        poses = [(turns[i].ravel(), places[i].ravel(), float(np.ravel(errors)[i])) for i in range(count)]
        return sorted(poses, key=lambda pose: pose[2])


def quaternion(turn):
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 1e-12 else np.zeros(3)
    return (np.cos(angle / 2), *(np.sin(angle / 2) * axis))


def covariance(marker, pose, camera):
    """Of translation and rotation (a rotation vector applied after the pose), from the corners' noise."""
    turn, place, _ = pose
    _, jacobian = cv2.projectPoints(marker.corners_m, turn, place, camera["matrix"], camera["distortion"])
    by_turn, by_place = jacobian[:, 0:3], jacobian[:, 3:6]
    rotation, step, columns = cv2.Rodrigues(turn)[0], 1e-3, []
    for i in range(3):
        other = turn + step * np.eye(3)[i]
        columns.append(cv2.Rodrigues(cv2.Rodrigues(other)[0] @ rotation.T)[0].ravel() / step)
    by_turn = by_turn @ np.linalg.inv(np.array(columns).T)
    both = np.hstack([by_place, by_turn])
    return np.linalg.pinv(both.T @ both) * CORNER_NOISE_PX**2


def write_transform(writer, pose):
    writer.doubles(pose[1]).doubles(quaternion(pose[0]))


def write_detections(name, header, marker, corners, camera, stages):
    writer = Writer(DETECTIONS).text(name)
    writer.data += header["encoded"]
    writer.unsigned(0 if corners is None else 1)
    if corners is not None:
        fits = camera is not None and camera["size"] == (header["width"], header["height"])
        poses = marker.poses(corners, camera) if fits else []
        centre = corners.mean(axis=0)
        if poses:
            turn, place, _ = poses[0]
            seen, _ = cv2.projectPoints(np.zeros((1, 3)), turn, place, camera["matrix"], camera["distortion"])
            centre = seen.ravel()
        size = max(np.linalg.norm(a - b) for a in corners for b in corners)
        writer.text(marker.family).byte(1).unsigned(marker.id)
        writer.doubles(centre).floats((CORNER_NOISE_PX**2 / 4, 0.0, CORNER_NOISE_PX**2 / 4))
        writer.byte(1).doubles(corners.ravel()).doubles([size]).byte(0).doubles([1.0])
        writer.byte(1 if poses else 0)
        if poses:
            write_transform(writer, poses[0])
            writer.doubles([poses[0][2]])
            writer.floats(covariance(marker, poses[0], camera)[np.triu_indices(6)])
            writer.byte(1 if len(poses) > 1 else 0)
            if len(poses) > 1:
                write_transform(writer, poses[1])
                writer.doubles([poses[1][2]])
    writer.unsigned(len(stages))
    for stage, micros in stages:
        writer.text(stage).unsigned(micros)
    return writer.bytes()


class Newest:
    """A mailbox that stores only the newest value: an old frame is useless."""

    def __init__(self):
        self.changed, self.value = threading.Condition(), None

    def put(self, value):
        with self.changed:
            self.value = value
            self.changed.notify()

    def take(self, timeout_s):
        with self.changed:
            if self.value is None:
                self.changed.wait(timeout_s)
            value, self.value = self.value, None
            return value


class Detector:
    def __init__(self, session, prefix, args):
        self.session, self.prefix, self.args = session, prefix, args
        self.frames, self.camera, self.stopped = Newest(), None, threading.Event()
        self.acks = None
        self.reported = set()

    def key(self, rest):
        return self.prefix + rest

    def take_camera(self, sample):
        try:
            self.camera = read_camera(sample.payload.to_bytes())
        except ValueError as error:
            self.warn("camera info", error)

    def take_frame(self, sample):
        """Acknowledges a JPEG frame as it arrives, on Zenoh's thread: a camera sends the next one over the air link then."""
        if self.args.input == "jpeg":
            try:
                header = read_header(sample.attachment.to_bytes())
                ack = Writer(FRAME_ACK).text(header["camera"]).unsigned(header["sequence"])
                ack.signed(header["stamp_ns"]).text(header["clock"]).unsigned(len(sample.payload.to_bytes()))
                self.acks.put(ack.bytes())
            except (ValueError, AttributeError) as error:
                self.warn("frame", error)
        self.frames.put(sample)

    def warn(self, subject, error):
        """Warns once for each kind: an invalid message must neither stop a detector nor fill its log."""
        if subject not in self.reported:
            self.reported.add(subject)
            print(f"{subject}: {error}; further ones are not reported", file=sys.stderr, flush=True)

    def obey(self, query):
        """Answers a command: whether it is accepted, and why not or the next step."""
        accepted, reason = False, "no command of this version"
        try:
            reader = Reader(query.payload.to_bytes(), DETECTOR_COMMAND)
            if reader.unsigned() == 1:
                accepted, reason = True, f"detector `{self.args.id}` stops"
            else:
                reason = f"`{reader.text()}` cannot be changed while this detector runs"
        except (ValueError, AttributeError) as error:
            reason = str(error)
        reply = Writer(COMMAND_REPLY).byte(1 if accepted else 0).text(reason).bytes()
        query.reply(query.key_expr, reply)
        if accepted:
            self.stopped.set()

    def info(self):
        writer = Writer(DETECTOR_INFO).text(self.args.id).text(platform.node())
        writer.unsigned(("onboard", "ground").index(self.args.place)).text(self.args.camera)
        writer.texts([self.args.marker.text])
        return writer.text(f"python, OpenCV {cv2.__version__}").unsigned(os.getpid()).bytes()

    def run(self):
        name, camera = self.args.id, self.args.camera
        urgent = {"priority": zenoh.Priority.REAL_TIME, "congestion_control": zenoh.CongestionControl.DROP}
        detections = self.session.declare_publisher(self.key(f"detector/{name}/detections"), **urgent)
        self.acks = self.session.declare_publisher(self.key(f"detector/{name}/ack"), **urgent)
        info_key = self.key(f"detector/{name}/info")
        topic = "frame" if self.args.input == "raw" else "jpeg"
        kept = [
            self.session.declare_queryable(info_key, lambda query: query.reply(info_key, self.info())),
            self.session.declare_queryable(self.key(f"detector/{name}/command"), self.obey),
            self.session.declare_subscriber(self.key(f"camera/{camera}/info"), self.take_camera),
            self.session.declare_subscriber(self.key(f"camera/{camera}/{topic}"), self.take_frame),
        ]
        # Ready means: able to locate a marker. The camera stores its last information for late subscribers.
        for reply in self.session.get(self.key(f"camera/{camera}/info"), timeout=2.0):
            if reply.ok is not None:
                self.take_camera(reply.ok)
        kept.append(self.session.liveliness().declare_token(self.key(f"alive/detector/{name}")))
        published_s = 0.0
        while not self.stopped.is_set():
            if time.monotonic() - published_s > 1.0:
                published_s = time.monotonic()
                self.session.put(info_key, self.info())
            sample = self.frames.take(0.2)
            if sample is not None:
                self.search(sample, detections)
        time.sleep(0.1)
        return kept

    def search(self, sample, detections):
        try:
            header = read_header(sample.attachment.to_bytes())
            payload = sample.payload.to_bytes()
            began = time.monotonic()
            corners = self.args.marker.find(header, payload)
            stages = [("opencv", int((time.monotonic() - began) * 1e6))]
            detections.put(
                write_detections(self.args.id, header, self.args.marker, corners, self.camera, stages)
            )
        except (ValueError, AttributeError, cv2.error) as error:
            self.warn("frame", error)


def configuration(args):
    """The session's configuration, and the prefix of keys."""
    if os.path.isfile(args.zenoh):
        # A file of the project: a peer like all others, whose keys get the vehicle's name from `namespace`.
        return zenoh.Config.from_file(args.zenoh), ""
    if args.zenoh not in ("", "local"):
        # With the addresses and keys of the environment; the program reports errors in them.
        ask = [args.alight, "config", "--session", f"detector.{args.id}", "--zenoh", args.zenoh]
        try:
            session = subprocess.run(ask, stdout=subprocess.PIPE, text=True, check=True)
        except OSError as error:
            sys.exit(f"`--zenoh {args.zenoh}` needs the program `alight` (--alight PROGRAM): {error}")
        except subprocess.CalledProcessError as error:
            sys.exit(error.returncode)
        return zenoh.Config.from_json5(session.stdout), ""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([args.connect]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config, args.vehicle + "/"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    port = os.environ.get("ALIGHT_MEET", "7447")
    parser.add_argument("--id", default="python")
    parser.add_argument("--place", choices=("onboard", "ground"), default="onboard")
    parser.add_argument("--camera", default="down")
    parser.add_argument("--marker", type=Marker, required=True, help="FAMILY:ID:SIZE_M")
    parser.add_argument("--input", choices=("raw", "jpeg"), default="raw")
    parser.add_argument("--zenoh", default=os.environ.get("ALIGHT_ZENOH", ""), help="`ground`, or a JSON5 file")
    parser.add_argument("--alight", default="alight", help="the program, for --zenoh ground")
    parser.add_argument("--connect", default=f"tcp/127.0.0.1:{port}", help="the rendezvous, without --zenoh")
    parser.add_argument("--vehicle", default=os.environ.get("ALIGHT_VEHICLE", "drone"))
    args = parser.parse_args()
    cv2.setNumThreads(1)
    config, prefix = configuration(args)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        sys.exit(f"no service of Alight is there: start one first, as `alight land` or `alight detector` ({error})")
    with session:
        detector = Detector(session, prefix, args)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: detector.stopped.set())
        print(f"Ready: {args.id}, {args.marker.text}", file=sys.stderr, flush=True)
        detector.run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
