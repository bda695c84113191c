#!/usr/bin/env python3
"""A ground station with a key for signed packets, and the effect of packets without it.

It asks the companion for a message, in each of these ways: signed; not signed; signed with another key; the signed packet
again; as a sender that is not known yet with a stamp of two minutes ago. Then it sends forged packets for a while, and
asks again. Only the first and the last may be answered. It waits for the companion's heartbeat before it sends, so the bridge must send
first (`ground = "udpout:..."`); a bridge that listens sends nothing before it has received a packet. It prints the result as one JSON object on the last line.

Exit status: 0 all was as it must be, 1 something was not, 77 pymavlink is missing (pip install pymavlink).
"""

import argparse
import hashlib
import json
import os
import statistics
import sys
import threading
import time

os.environ.setdefault("MAVLINK20", "1")
try:
    from pymavlink import mavutil
except ImportError:
    print("skipped: pymavlink is missing (pip install pymavlink)")
    sys.exit(77)

mavlink = mavutil.mavlink

COMPANION = 191
GROUND = 255
NEWCOMER = 77
ANSWER_S = 1.0
STAMPS_PER_S = 100_000


class Station:
    """A connection whose packets are signed as it is asked."""

    def __init__(self, connect, key):
        self.connection = mavutil.mavlink_connection(
            connect, source_system=GROUND, source_component=190, dialect="ardupilotmega"
        )
        self.mav = self.connection.mav
        self.connection.setup_signing(key, sign_outgoing=True)
        self.unsigned = 0
        self.beats = []

    def next(self, kind, seconds):
        """The companion's next message of a kind; counts unsigned ones, and stores the times of heartbeats."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            message = self.connection.recv_match(blocking=True, timeout=left)
            if message is None:
                return None
            if message.get_type().startswith("UNKNOWN"):
                continue  # pymavlink checks no signature of a message that its dialect does not have.
            if message.get_type() == "BAD_DATA" or not message.get_signed():
                self.unsigned += 1
                continue
            if message.get_srcComponent() != COMPANION:
                continue
            if message.get_type() == "HEARTBEAT":
                self.beats.append(time.monotonic())
            if message.get_type() == kind:
                return message
        return None

    def packet(self, sign=True, key=None, component=None, stamp=None):
        """A request to the companion, as bytes."""
        mav, signing = self.mav, self.mav.signing
        kept = (signing.sign_outgoing, signing.secret_key, mav.srcComponent, signing.timestamp)
        signing.sign_outgoing = sign
        signing.secret_key = key or signing.secret_key
        mav.srcComponent = component or mav.srcComponent
        signing.timestamp = stamp or signing.timestamp
        asked = mav.command_long_encode(self.vehicle, COMPANION, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, 1, 0, 0, 0, 0, 0, 0)
        raw = bytes(asked.pack(mav))
        signing.sign_outgoing, signing.secret_key, mav.srcComponent, stamp = kept
        signing.timestamp = max(stamp, signing.timestamp)
        return raw

    def is_answered(self, raw):
        self.connection.write(raw)
        return self.next("COMMAND_ACK", ANSWER_S) is not None


def flood(station, rate, seconds):
    """Sends forged packets; the number of them, and the longest pause between heartbeats meanwhile, in seconds."""
    forged = station.packet(key=b"\x07" * 32)
    sent = 0
    ended = threading.Event()

    def send():
        nonlocal sent
        began = time.monotonic()
        while (passed := time.monotonic() - began) < seconds:
            while sent < passed * rate:
                station.connection.write(forged)
                sent += 1
            time.sleep(0.001)
        ended.set()

    station.beats.clear()
    sending = threading.Thread(target=send)
    sending.start()
    while not ended.is_set():
        station.next("HEARTBEAT", 0.5)
    sending.join()
    return sent, pauses(station.beats)


def pauses(beats):
    return [after - before for before, after in zip(beats, beats[1:])]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--connect", default="udpin:127.0.0.1:14550", help="where to listen, as pymavlink writes it; the bridge must send first (udpout)")
    parser.add_argument("--passphrase", required=True, help="the bridge's")
    parser.add_argument("--flood-rate", type=float, default=10_000.0, help="forged packets per second")
    parser.add_argument("--flood-s", type=float, default=5.0, help="for how long, in seconds")
    options = parser.parse_args()

    station = Station(options.connect, hashlib.sha256(options.passphrase.encode()).digest())
    heartbeat = station.next("HEARTBEAT", 30.0)
    assert heartbeat is not None, "no signed heartbeat of the companion"
    station.vehicle = heartbeat.get_srcSystem()

    signed = station.packet()
    minutes_ago = station.mav.signing.timestamp - 120 * STAMPS_PER_S
    answered = {
        "signed": station.is_answered(signed),
        "unsigned": station.is_answered(station.packet(sign=False)),
        "another key": station.is_answered(station.packet(key=b"\x01" * 32)),
        "replayed": station.is_answered(signed),
        "old": station.is_answered(station.packet(component=NEWCOMER, stamp=minutes_ago)),
    }
    station.beats.clear()
    until = time.monotonic() + options.flood_s
    while time.monotonic() < until:
        station.next("HEARTBEAT", 0.5)
    quiet = pauses(station.beats)
    sent, flooded = flood(station, options.flood_rate, options.flood_s)
    answered["after the flood"] = station.is_answered(station.packet())
    result = {
        "answered": answered,
        "received_unsigned": station.unsigned,
        "forged": sent,
        "heartbeats": {
            "quiet_max_s": round(max(quiet), 3),
            "flooded_median_s": round(statistics.median(flooded), 3),
            "flooded_max_s": round(max(flooded), 3),
        },
    }
    expected = {name: name in ("signed", "after the flood") for name in answered}
    result["ok"] = answered == expected and station.unsigned == 0 and len(flooded) > 0
    print(json.dumps(result))
    return 0 if result["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
