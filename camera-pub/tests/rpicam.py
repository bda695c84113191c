#!/usr/bin/env python3
"""A camera program that writes frames and metadata as rpicam-vid does, with the number of each frame in its pixels.

    rpicam.py METADATA FAULT

Frames of 64 x 48 grey pixels every 40 ms, 30 ms after their sensor stamp. The number stands in the first two pixels, the
sensor's stamp (nanoseconds, lowest byte first) in the next eight. The metadata are written as
raspberrypi/rpicam-apps does (output/output.cpp): the closing brace of an object comes with the next one.
FAULT: none, or the fault of one line in five: late, torn, doubled, lost; or clock: stamps of the wall clock.
"""

import sys
import time

PERIOD_NS, DELAY_NS, EXPOSURE_US = 40_000_000, 30_000_000, 4000
# The frames by which metadata and frames have been found to agree.
AGREED = 8


def metadata_of(stamp_ns):
    if fault == "clock":
        stamp_ns += time.time_ns() - time.monotonic_ns()
    return (
        '{\n    "SensorTimestamp": ' + str(stamp_ns) + ',\n    "ScalerCrop": "(0, 0)/1456x1088",\n'
        '    "ColourGains": [ 1.9, 1.6 ],\n    "AnalogueGain": 2.000000,\n'
        '    "ExposureTime": ' + str(EXPOSURE_US) + "\n"
    )


def sleep_until(time_ns):
    while (left_ns := time_ns - time.clock_gettime_ns(time.CLOCK_BOOTTIME)) > 0:
        time.sleep(left_ns * 1e-9)


path, fault = sys.argv[1:]
metadata = open(path, "w", encoding="ascii")
metadata.write("[\n")
metadata.flush()
separator, held_back = "", ""
start_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
for number in range(10_000):
    stamp_ns = start_ns + number * PERIOD_NS
    sleep_until(stamp_ns + DELAY_NS)
    pixels = number.to_bytes(2, "little") + stamp_ns.to_bytes(8, "little")
    sys.stdout.buffer.write(pixels.ljust(64 * 48, b"\x80"))
    sys.stdout.buffer.flush()
    text = separator + metadata_of(stamp_ns)
    separator = "},\n"
    is_hit = number > AGREED and number % 5 == 0
    if is_hit and fault == "late":
        held_back = text
        continue
    if is_hit and fault == "lost":
        continue
    if is_hit and fault == "torn":
        text = text[: len(text) // 2] + "\n"
    if is_hit and fault == "doubled":
        text += text[text.index("{") :].join([separator, ""])
    metadata.write(held_back + text)
    held_back = ""
    metadata.flush()
