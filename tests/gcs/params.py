#!/usr/bin/env python3
"""A ground station that loads the companion's parameters as QGroundControl does, over a link that loses packets.

It asks all components for their lists, again after 5 s without any value (at most four times). After 3 s without a value it
asks for the missing ones by their indices, ten at a time, each at most five times. Then it sets one, to a number and to
none. It prints the result as one JSON object on the last line.

Exit status: 0 all was there, 1 something was not, 77 pymavlink is missing (pip install pymavlink).
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

COMPANION = 191
LISTS, LIST_S = 4, 5.0
READS, BATCH, VALUE_S = 5, 10, 3.0
PATIENCE_S = 120.0
# Longest time until all are loaded, in seconds: without losses, and with them.
MAX_LOADED_S, MAX_LOADED_LOSSY_S = 3.0, 15.0


class Link:
    """A connection that loses a fraction of the packets in each direction."""

    def __init__(self, connection, loss, seed):
        self.connection = connection
        self.losses = Losses(loss, seed)
        self.vehicle = None

    def send(self, send, *fields):
        if not self.losses.takes(send.__name__, *fields):
            send(*fields)

    def next(self, kinds, seconds):
        """The companion's next message of these kinds within these seconds."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            message = self.connection.recv_match(type=kinds, blocking=True, timeout=left)
            if message is None or message.get_srcComponent() != COMPANION:
                continue
            if not self.losses.takes(message.get_type(), getattr(message, "param_id", "")):
                return message
        return None


def load(link):
    """The values by index, as QGroundControl gets them."""
    mav = link.connection.mav
    values, reads, asked, lists = {}, {}, set(), 0
    began = received = time.monotonic()
    while time.monotonic() - began < PATIENCE_S:
        count = next((it.param_count for it in values.values()), None)
        if count is not None and len(values) == count:
            return values
        if count is None:
            if lists == LISTS:
                raise AssertionError(f"no parameter after {LISTS} requests for the list")
            lists += 1
            link.send(mav.param_request_list_send, link.vehicle, 0)
        elif time.monotonic() - received >= VALUE_S or asked:
            if time.monotonic() - received >= VALUE_S:
                asked.clear()
                received = time.monotonic()
            missing = [index for index in range(count) if index not in values and index not in asked]
            for index in missing[: BATCH - len(asked)]:
                reads[index] = reads.get(index, 0) + 1
                assert reads[index] <= READS, f"parameter {index} did not come after {READS} requests"
                asked.add(index)
                link.send(mav.param_request_read_send, link.vehicle, COMPANION, b"", index)
        value = link.next("PARAM_VALUE", LIST_S if count is None else max(0.01, received + VALUE_S - time.monotonic()))
        if value is not None:
            received = time.monotonic()
            asked.discard(value.param_index)
            assert value.param_type == mavlink.MAV_PARAM_TYPE_REAL32, value
            values[value.param_index] = value
    raise AssertionError(f"{len(values)} of {count} parameters after {PATIENCE_S} s")


def set_one(link, before, wanted):
    """The value after an attempt to change it, and the status texts."""
    mav = link.connection.mav
    texts, after = [], None
    for _ in range(5):
        link.send(
            mav.param_set_send, link.vehicle, COMPANION, before.param_id.encode(), wanted, mavlink.MAV_PARAM_TYPE_REAL32
        )
        until = time.monotonic() + 1.5
        while (left := until - time.monotonic()) > 0:
            message = link.next(["PARAM_VALUE", "STATUSTEXT"], left)
            if message is None:
                break
            if message.get_type() == "STATUSTEXT":
                texts.append(message.text)
            elif message.param_id == before.param_id:
                after = message.param_value
        if after is not None and texts:
            break
    return {"after": after, "said": "".join(texts)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--connect", default="udpin:127.0.0.1:14550", help="where to listen, as pymavlink writes it")
    parser.add_argument("--loss", type=float, default=0.0, help="fraction of packets lost in each direction")
    parser.add_argument("--seed", type=int, default=1, help="which packets are lost")
    parser.add_argument("--name", default="AL_DESC_SPEED", help="the parameter that is set")
    options = parser.parse_args()

    connection = mavutil.mavlink_connection(
        options.connect, source_system=255, source_component=190, dialect="ardupilotmega"
    )
    link = Link(connection, options.loss, options.seed)
    heartbeat = link.next("HEARTBEAT", 30.0)
    assert heartbeat is not None, "no heartbeat of the companion"
    link.vehicle = heartbeat.get_srcSystem()
    began = time.monotonic()
    values = load(link)
    loaded_s = round(time.monotonic() - began, 2)
    named = {value.param_id: value for value in values.values()}
    result = {"loss": options.loss, "seed": options.seed, "parameters": len(values), "names": len(named), "loaded_s": loaded_s}
    before = named[options.name]
    result["value"] = before.param_value
    result["set"] = [set_one(link, before, wanted) for wanted in (before.param_value + 1, float("nan"))]
    # Of a text of several packets a lossy link may lose one or all.
    is_kept = all(it["after"] == before.param_value for it in result["set"])
    if options.loss == 0:
        is_kept = is_kept and all(options.name in it["said"] for it in result["set"])
    is_quick = loaded_s <= (MAX_LOADED_S if options.loss == 0 else MAX_LOADED_LOSSY_S)
    result["ok"] = is_kept and is_quick and len(named) == len(values)
    print(json.dumps(result))
    return 0 if result["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
