#!/usr/bin/env python3
"""A ground station that searches for the vehicle's camera as QGroundControl does, over a link that loses packets.

After the camera's heartbeat it asks for CAMERA_INFORMATION, at most ten times, now with MAV_CMD_REQUEST_MESSAGE and now
with MAV_CMD_REQUEST_CAMERA_INFORMATION, and waits 2^(n/2) seconds each time; then for settings, video stream, capture
status and storage. Then it has the marker tracked. With --commands it sends every MAV_CMD of the dialect to both
components and counts those without an acknowledgement. It prints the result as one JSON object on the last line.

Exit status: 0 all was found, 1 something was not, 77 pymavlink is missing (pip install pymavlink).
"""

import argparse
import json
import os
import sys
import time

from losses import Losses

os.environ.setdefault("MAVLINK20", "1")
try:
    from pymavlink import mavutil
except ImportError:
    print("skipped: pymavlink is missing (pip install pymavlink)")
    sys.exit(77)

mavlink = mavutil.mavlink

CAMERA = 100
COMPANION = 191
# The messages that are requested after CAMERA_INFORMATION: the number, and the command that requests it in older ground stations.
FURTHER = {
    "CAMERA_SETTINGS": (260, mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS),
    "VIDEO_STREAM_INFORMATION": (269, mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION),
    "CAMERA_CAPTURE_STATUS": (262, mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS),
    "STORAGE_INFORMATION": (261, mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION),
}
ATTEMPTS = 10
# Longest time from the camera's heartbeat until all is found where no packet is lost, in seconds. With losses chance decides which of
# the attempts, ever farther apart, comes through; one of them must.
MAX_FOUND_S = 3.0


class Link:
    """A connection that loses a fraction of the packets in each direction."""

    def __init__(self, connection, loss, seed):
        self.connection = connection
        self.loss = loss
        self.losses = Losses(loss, seed)
        self.vehicle = None

    def command(self, component, command, *params):
        if not self.losses.takes("command", component, command, *params):
            params = (list(params) + [0] * 7)[:7]
            self.connection.mav.command_long_send(self.vehicle, component, command, 0, *params)

    def wait(self, kind, seconds, component=CAMERA, fits=lambda message: True):
        """The first such message within these seconds."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            message = self.connection.recv_match(blocking=True, timeout=0.05)
            is_it = message is not None and message.get_type() == kind and message.get_srcComponent() == component
            if is_it and fits(message) and not self.losses.takes(kind, component):
                return message
        return None


def find_camera(link, began):
    """The found messages, requested as QGroundControl does, and their times."""
    heartbeat = link.wait("HEARTBEAT", 30.0, fits=lambda it: it.type == mavlink.MAV_TYPE_CAMERA)
    if heartbeat is None:
        return {"problem": "no heartbeat of a camera"}
    link.vehicle = heartbeat.get_srcSystem()
    connected = time.monotonic()
    found = {"heartbeat_s": round(connected - began, 2)}
    information = None
    for attempt in range(ATTEMPTS):
        if attempt % 2 == 0:
            link.command(CAMERA, mavlink.MAV_CMD_REQUEST_MESSAGE, 259)
        else:
            link.command(CAMERA, mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION, 1)
        information = link.wait("CAMERA_INFORMATION", 2 ** (attempt / 2))
        if information is not None:
            break
    if information is None:
        return {**found, "problem": f"gave up requesting camera information from {link.vehicle} {CAMERA}"}
    found["information"] = {
        "vendor": bytes(information.vendor_name).rstrip(b"\0").decode(),
        "model": bytes(information.model_name).rstrip(b"\0").decode(),
        "size": [information.resolution_h, information.resolution_v],
        "flags": information.flags,
    }
    for kind, (number, legacy) in FURTHER.items():
        for attempt in range(ATTEMPTS):
            if attempt % 2 == 0:
                link.command(CAMERA, mavlink.MAV_CMD_REQUEST_MESSAGE, number)
            else:
                link.command(CAMERA, legacy, 1)
            message = link.wait(kind, 0.5)
            if message is not None:
                break
        if message is None:
            return {**found, "problem": f"no {kind}"}
        if kind == "VIDEO_STREAM_INFORMATION":
            found["stream"] = {"type": message.type, "uri": message.uri}
    found["found_s"] = round(time.monotonic() - connected, 2)
    if link.loss == 0 and found["found_s"] > MAX_FOUND_S:
        found["problem"] = f"it took more than {MAX_FOUND_S} s"
    return found


def track(link, area):
    """The bounds of the tracked marker, after pointing at it."""
    for _ in range(ATTEMPTS):
        link.command(CAMERA, mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *area)
        link.command(CAMERA, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 275, 100_000)
        status = link.wait("CAMERA_TRACKING_IMAGE_STATUS", 1.0, fits=lambda it: it.tracking_status == 1)
        if status is not None:
            return [status.rec_top_x, status.rec_top_y, status.rec_bottom_x, status.rec_bottom_y]
    return None


def unanswered(link):
    """Commands of the dialect that a component did not acknowledge."""
    commands = [it for it in mavlink.enums["MAV_CMD"] if it < 65535 and "ENUM_END" not in mavlink.enums["MAV_CMD"][it].name]
    missing = []
    for component in (CAMERA, COMPANION):
        for command in commands:
            link.command(component, command)
            if link.wait("COMMAND_ACK", 2.0, component, lambda it: it.command == command) is None:
                missing.append([component, mavlink.enums["MAV_CMD"][command].name])
    return {"commands": len(commands), "unanswered": missing}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--connect", default="udpin:127.0.0.1:14550", help="where to listen, as pymavlink writes it")
    parser.add_argument("--loss", type=float, default=0.0, help="fraction of packets lost in each direction")
    parser.add_argument("--seed", type=int, default=1, help="which packets are lost")
    parser.add_argument("--area", type=float, nargs=4, default=[0, 0, 1, 1], help="rectangle to point at, 0 to 1")
    parser.add_argument("--commands", action="store_true", help="send every command to both components")
    options = parser.parse_args()

    connection = mavutil.mavlink_connection(
        options.connect, source_system=255, source_component=190, dialect="ardupilotmega"
    )
    link = Link(connection, options.loss, options.seed)
    found = find_camera(link, time.monotonic())
    if "problem" not in found:
        found["tracked"] = track(link, options.area)
        if found["tracked"] is None:
            found["problem"] = "no tracked marker"
    if options.commands and "problem" not in found:
        found |= unanswered(link)
        if found["unanswered"]:
            found["problem"] = "commands without acknowledgement"
    print(json.dumps({"ok": "problem" not in found, "loss": options.loss, **found}))
    return 1 if "problem" in found else 0


if __name__ == "__main__":
    sys.exit(main())
