#!/usr/bin/env python3
"""Writes `flight.tlog`, a short flight of a made-up copter, with pymavlink, and `flight.events.json`: its changes with their times.

    python3 flight.py       (needs pymavlink)

The flight is the project's own, so that each clone can compare its reading of MAVLink with another implementation's.
"""

import io
import json
import math
import pathlib
import struct

from pymavlink.dialects.v20 import ardupilotmega as mavlink

STABILIZE, GUIDED, LAND = 0, 4, 9
ON_GROUND, IN_AIR, TAKING_OFF, LANDING = 1, 2, 3, 4
START_US = 1_700_000_000_000_000
# From which second on: flight mode, armed, landed state.
STEPS = [
    (0, STABILIZE, False, ON_GROUND),
    (2, GUIDED, False, ON_GROUND),
    (3, GUIDED, True, ON_GROUND),
    (4, GUIDED, True, TAKING_OFF),
    (6, GUIDED, True, IN_AIR),
    (13, LAND, True, IN_AIR),
    (14, LAND, True, LANDING),
    (19, LAND, True, ON_GROUND),
    (20, LAND, False, ON_GROUND),
]
END_S = 22
HEIGHTS_M = [(4, 0.0), (7, 5.0), (13, 5.0), (19, 0.0)]


def height_m(t):
    for (t0, h0), (t1, h1) in zip(HEIGHTS_M, HEIGHTS_M[1:]):
        if t0 <= t <= t1:
            return h0 + (h1 - h0) * (t - t0) / (t1 - t0)
    return 0.0


def main():
    link = mavlink.MAVLink(io.BytesIO(), srcSystem=1, srcComponent=1)
    log, events, landed_before = bytearray(), [], None

    def write(t, message):
        log.extend(struct.pack(">Q", START_US + round(t * 1e6)) + message.pack(link))
        link.seq = (link.seq + 1) % 256

    for tick in range(END_S * 5):
        t = tick / 5
        ms = tick * 200
        _, mode, armed, landed = [step for step in STEPS if step[0] <= t][-1]
        if tick % 5 == 0:
            base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
            state = mavlink.MAV_STATE_ACTIVE if armed else mavlink.MAV_STATE_STANDBY
            copter, ardupilot = mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
            write(t, mavlink.MAVLink_heartbeat_message(copter, ardupilot, base, mode, state, 3))
            events.append({"wall": t, "name": "HEARTBEAT", "base_mode": base, "custom_mode": mode})
        write(t, mavlink.MAVLink_extended_sys_state_message(mavlink.MAV_VTOL_STATE_UNDEFINED, landed))
        if landed != landed_before:
            events.append({"wall": t, "name": "LANDED_STATE", "v": landed})
            landed_before = landed
        swing = 0.05 * math.sin(t)
        write(t, mavlink.MAVLink_attitude_message(ms, swing, -swing, 0.3, 0.01, -0.01, 0.0))
        down, speed = -height_m(t), (height_m(t) - height_m(t + 0.1)) / 0.1
        write(t, mavlink.MAVLink_local_position_ned_message(ms, 1.0, -2.0, down, 0.1, 0.0, speed))
    here = pathlib.Path(__file__).parent
    here.joinpath("flight.tlog").write_bytes(log)
    rows = ",\n".join(json.dumps(event) for event in events)
    here.joinpath("flight.events.json").write_text(f"[\n{rows}\n]\n")


main()
