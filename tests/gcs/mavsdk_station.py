#!/usr/bin/env python3
"""A program of MAVSDK at the vehicle's link: does it find the vehicle, its position, its parameters and its camera?

It waits for the autopilot, its position and all of its parameters, and with --camera for the camera's information and video
stream. Times count from the first packet's arrival on. It prints the result as one JSON object on the last line.

    python3 tests/gcs/mavsdk_station.py --connect udpin://127.0.0.1:14550 --camera

Exit status: 0 all was found, 1 something was not, 77 MAVSDK is missing (pip install mavsdk).
"""

import argparse
import json
import sys
import threading
import time

try:
    from mavsdk import ComponentType, Configuration, Mavsdk
    from mavsdk.plugins.camera import Camera, CameraError
    from mavsdk.plugins.param import Param
    from mavsdk.plugins.telemetry import Telemetry
except (ImportError, OSError) as problem:
    print(f"skipped: MAVSDK is missing (pip install mavsdk): {problem}")
    sys.exit(77)


def first(subscribe, seconds, fits=lambda it: True):
    """The first published value that fits; none after these seconds."""
    came, found = threading.Event(), []

    def take(it, _):
        if not found and fits(it):
            found.append(it)
            came.set()

    subscribe(take)
    came.wait(seconds)
    return found[0] if found else None


def stream(camera, component, seconds):
    """The address of the camera's video, as soon as MAVSDK has received it; none after these seconds."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        try:
            # Before it has received an address it returns an empty one.
            if uri := camera.get_video_stream_info(component).settings.uri:
                return uri
        except CameraError:
            pass
        time.sleep(0.05)
    return None


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--connect", default="udpin://127.0.0.1:14550", help="where to listen, as MAVSDK writes it")
    parser.add_argument("--camera", action="store_true", help="look for the camera as well")
    parser.add_argument("--timeout", type=float, default=30.0, help="longest wait for each, in seconds")
    options = parser.parse_args()

    found, problems = {}, []
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    began = time.monotonic()
    sdk.add_any_connection(options.connect)
    system = sdk.first_autopilot(options.timeout)
    if system is None:
        print(json.dumps({"ok": False, "problem": "no autopilot"}))
        return 1
    connected = time.monotonic()
    found["connected_s"] = round(connected - began, 3)

    telemetry = Telemetry(system)
    # ArduPilot sends the position only on request.
    telemetry.set_rate_position(5.0)
    position = first(telemetry.subscribe_position, options.timeout)
    found["position_s"] = round(time.monotonic() - connected, 3)
    if position is None:
        problems.append("no position")
    else:
        found["position"] = [round(position.latitude_deg, 5), round(position.longitude_deg, 5), round(position.relative_altitude_m, 1)]

    asked = time.monotonic()
    parameters = Param(system).get_all_params()
    found["parameters_s"] = round(time.monotonic() - asked, 3)
    found["parameters"] = len(parameters.int_params) + len(parameters.float_params)
    if found["parameters"] == 0:
        problems.append("no parameters")

    if options.camera:
        asked = time.monotonic()
        camera = Camera(system)
        listed = first(camera.subscribe_camera_list, options.timeout, lambda it: any(one.model_name for one in it.cameras))
        found["camera_s"] = round(time.monotonic() - asked, 3)
        if listed is None:
            problems.append("no camera")
        else:
            information = listed.cameras[0]
            found["camera"] = {
                "component": information.component_id,
                "vendor": information.vendor_name,
                "model": information.model_name,
                "size": [information.horizontal_resolution_px, information.vertical_resolution_px],
            }
            found["video"] = stream(camera, information.component_id, options.timeout)
            found["video_s"] = round(time.monotonic() - asked, 3)
            if found["video"] is None:
                problems.append("no video stream")
    found["ok"] = not problems
    if problems:
        found["problem"] = ", ".join(problems)
    print(json.dumps(found), flush=True)
    sdk.destroy()
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
