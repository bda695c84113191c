#!/usr/bin/env python3
"""A ground station that checks the received messages: is this vehicle fit for QGroundControl?

It listens where QGroundControl would, and waits for the vehicle's heartbeat, the companion's (component 191), texts
about the landing (STATUSTEXT), and the landing point (LANDING_TARGET); it asks the vehicle for a parameter, and the
companion for its parameters, as ground stations do when they start, and for something it cannot do. It prints the result as one JSON object on the last line.

    python3 tests/gcs/ground_station.py --connect udpin:127.0.0.1:14550

Exit status: 0 all was seen, 1 something was not, 77 pymavlink is missing (pip install pymavlink).
"""

import argparse
import json
import os
import sys
import time

os.environ.setdefault("MAVLINK20", "1")
try:
    from pymavlink import mavutil
except ImportError:
    print("skipped: pymavlink is missing (pip install pymavlink)")
    sys.exit(77)

mavlink = mavutil.mavlink

# The messages that must be received, in the order of the report.
CHECKS = (
    "vehicle_heartbeat",
    "companion_heartbeat",
    "statustext",
    "landing_target",
    "parameter",
    "companion_answer",
)


class GroundStation:
    """The messages that were received so far."""

    def __init__(self, connection, component, parameter, echo):
        self.connection = connection
        self.component = component
        self.parameter = parameter
        self.echo = echo
        self.vehicle = None
        self.seen = dict.fromkeys(CHECKS)
        self.texts = []
        self.parts = {}
        self.packets = 0
        self.targets = []

    def missing(self):
        return [name for name in CHECKS if self.seen[name] is None]

    def take(self, message):
        """Stores one message under the check that it passes."""
        self.packets += 1
        kind = message.get_type()
        system, component = message.get_srcSystem(), message.get_srcComponent()
        if kind == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID and component == 1:
            self.vehicle = system
            self.seen["vehicle_heartbeat"] = {"system": system, "type": message.type, "mode": message.custom_mode}
        elif kind == "HEARTBEAT" and component == self.component:
            if message.type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER and system == self.vehicle:
                self.seen["companion_heartbeat"] = {"system": system, "state": message.system_status}
        elif kind == "STATUSTEXT" and component == self.component:
            self.take_text(message)
        elif kind == "LANDING_TARGET" and component == self.component:
            self.take_target(message)
        elif kind == "PARAM_VALUE" and component == 1 and message.param_id == self.parameter:
            self.seen["parameter"] = {message.param_id: message.param_value}
        elif kind == "COMMAND_ACK" and component == self.component:
            if message.result == mavlink.MAV_RESULT_UNSUPPORTED:
                self.seen["companion_answer"] = {"command": message.command, "result": message.result}

    def take_text(self, message):
        """Joins the parts of a text; a part that is shorter than 50 characters is the last."""
        part = message.text
        text = self.parts.pop(message.id, "") + part if message.id else part
        if message.id and len(part) == 50:
            self.parts[message.id] = text
            return
        self.texts.append(text)
        self.seen["statustext"] = self.texts[-20:]
        if self.echo:
            print(f"[{message.severity}] {text}", file=sys.stderr)

    def take_target(self, message):
        """Counts a landing point if it is a position in local NED."""
        self.targets.append(time.monotonic())
        if message.frame == mavlink.MAV_FRAME_LOCAL_NED and message.position_valid == 1:
            place = [round(value, 3) for value in (message.x, message.y, message.z)]
            self.seen["landing_target"] = {"position_ned_m": place, "distance_m": round(message.distance, 3)}

    def ask(self):
        """Sends a ground station's heartbeat, and requests the missing messages."""
        send = self.connection.mav
        send.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE)
        if self.vehicle is None:
            return
        if self.seen["statustext"] is None:
            # The companion repeats its texts for a ground station that begins so; another one may have received them before.
            send.param_request_list_send(self.vehicle, self.component)
        if self.seen["parameter"] is None:
            send.param_request_read_send(self.vehicle, 1, self.parameter.encode(), -1)
        if self.seen["companion_answer"] is None:
            command = mavlink.MAV_CMD_REQUEST_MESSAGE
            send.command_long_send(self.vehicle, self.component, command, 0, 148, 0, 0, 0, 0, 0, 0)


def target_rate_hz(times):
    """Landing points a second, from the first to the last."""
    if len(times) < 2 or times[-1] <= times[0]:
        return None
    return round((len(times) - 1) / (times[-1] - times[0]), 1)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--connect", default="udpin:127.0.0.1:14550", help="where to listen, as pymavlink writes it")
    parser.add_argument("--timeout", type=float, default=90.0, help="seconds to wait for missing messages")
    parser.add_argument("--duration", type=float, default=0.0, help="seconds to watch at least, even when all was seen")
    parser.add_argument("--component", type=int, default=191, help="component number of the companion")
    parser.add_argument("--parameter", default="LAND_SPEED", help="parameter to ask the vehicle for")
    parser.add_argument("--echo", action="store_true", help="print the texts as they come, to standard error")
    options = parser.parse_args()

    connection = mavutil.mavlink_connection(
        options.connect, source_system=255, source_component=190, dialect="ardupilotmega"
    )
    station = GroundStation(connection, options.component, options.parameter, options.echo)
    began = time.monotonic()
    asked = began - 1.0
    while True:
        elapsed = time.monotonic() - began
        if elapsed > options.timeout or (not station.missing() and elapsed >= options.duration):
            break
        # Requests need a system that has sent a packet.
        if station.packets and time.monotonic() - asked >= 1.0:
            asked = time.monotonic()
            station.ask()
        message = connection.recv_match(blocking=True, timeout=0.2)
        if message is not None and message.get_type() != "BAD_DATA":
            station.take(message)

    missing = station.missing()
    summary = {
        "ok": not missing,
        "missing": missing,
        "seconds": round(time.monotonic() - began, 1),
        "packets": station.packets,
        "landing_target_hz": target_rate_hz(station.targets),
        **station.seen,
    }
    print(json.dumps(summary))
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
