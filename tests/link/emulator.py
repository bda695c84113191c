#!/usr/bin/env python3
"""A radio link between two network interfaces: rate, delay, jitter, loss, a queue that fills up, and cuts.

Makes two TUN interfaces and carries the packets of each to the other. A direction is a queue (1000 packets, as tc netem
has), a sender of so many bits a second, and a delay that changes but never reorders; a packet is lost on the way. It
needs the right to make interfaces, and nothing but Python's standard library.

    python3 tests/link/emulator.py INTERFACE INTERFACE

prints `ready`, and then takes one JSON object a line: {"rate_mbit": 20, "delay_ms": 5, "jitter_ms": 2, "loss": 0.02,
"cut": false, "marks": false}, of which any key may be left out. With `marks` packets marked for expedited forwarding
(DSCP 46) go first, as some radios do. It answers each line with the packets sent, lost and refused so far, and ends with
its input. Exit status 77: there is no TUN device, or no right to use it.
"""

import fcntl
import json
import os
import random
import select
import struct
import sys
import time
from collections import deque

TUNSETIFF = 0x400454CA
IFF_TUN, IFF_NO_PI = 0x0001, 0x1000
QUEUE = 1000
EXPEDITED = 46


def interface(name):
    try:
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TUN | IFF_NO_PI))
    except OSError as problem:
        print(f"skipped: making the interface {name}: {problem}", flush=True)
        sys.exit(77)
    return device


class Direction:
    """From one interface to the other."""

    def __init__(self, settings, source, target):
        self.settings, self.source, self.target = settings, source, target
        self.urgent, self.usual = deque(), deque()
        self.free_at = 0.0  # when the sender has sent its current packet
        self.flying = deque()  # (arrival, packet)
        self.counts = {"sent": 0, "lost": 0, "refused": 0}

    def take(self, now):
        while True:
            try:
                packet = os.read(self.source, 65536)
            except BlockingIOError:
                return
            if self.settings["cut"]:
                self.counts["lost"] += 1
            elif len(self.urgent) + len(self.usual) >= QUEUE:
                self.counts["refused"] += 1
            else:
                marked = self.settings["marks"] and packet[0] >> 4 == 4 and packet[1] >> 2 == EXPEDITED
                (self.urgent if marked else self.usual).append((now, packet))

    def advance(self, now):
        """Sends and delivers the packets that are due; returns the time of the next call, or None."""
        s = self.settings
        if s["cut"]:
            self.counts["lost"] += len(self.urgent) + len(self.usual) + len(self.flying)
            for queue in (self.urgent, self.usual, self.flying):
                queue.clear()
        while (self.urgent or self.usual) and self.free_at <= now:
            came, packet = (self.urgent or self.usual).popleft()
            # However late this process wakes up: a sender that is busy sends on without a pause.
            self.free_at = max(self.free_at, came) + len(packet) * 8e-6 / s["rate_mbit"]
            if random.random() < s["loss"]:
                self.counts["lost"] += 1
                continue
            delay = 1e-3 * (s["delay_ms"] + random.uniform(-1, 1) * s["jitter_ms"])
            arrival = self.free_at + max(delay, 0)
            if self.flying:
                arrival = max(arrival, self.flying[-1][0])
            self.flying.append((arrival, packet))
        while self.flying and self.flying[0][0] <= now:
            packet = self.flying.popleft()[1]
            try:
                os.write(self.target, packet)
                self.counts["sent"] += 1
            except OSError:  # the interface is down
                self.counts["lost"] += 1
        due = [self.flying[0][0]] if self.flying else []
        if self.urgent or self.usual:
            due.append(self.free_at)
        return min(due) if due else None


def main(names):
    settings = {"rate_mbit": 1000.0, "delay_ms": 0.0, "jitter_ms": 0.0, "loss": 0.0, "cut": False, "marks": False}
    a, b = interface(names[0]), interface(names[1])
    try:
        os.nice(-10)  # a radio does not wait for a processor
    except OSError:
        pass
    directions = [Direction(settings, a, b), Direction(settings, b, a)]
    print("ready", flush=True)
    lines = b""
    os.set_blocking(0, False)
    wake = None
    while True:
        pause = None if wake is None else max(0.0, wake - time.monotonic())
        readable, _, _ = select.select([0, a, b], [], [], pause)
        for direction in directions:
            if direction.source in readable:
                direction.take(time.monotonic())
        if 0 in readable:
            data = os.read(0, 65536)
            if not data:
                return
            lines += data
            *complete, lines = lines.split(b"\n")
            for line in complete:
                settings.update(json.loads(line))
                print(json.dumps([direction.counts for direction in directions]), flush=True)
        now = time.monotonic()
        due = [at for at in (direction.advance(now) for direction in directions) if at is not None]
        wake = min(due) if due else None


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(sys.argv[1:])
