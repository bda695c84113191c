"""Reads calibration files with OpenCV and by the documented fields of ROS and Kalibr, writes some with OpenCV, and projects
points with all of them. The task is a JSON file, and the pixels are written into another."""

import json
import sys

try:
    import cv2
    import numpy as np
except ImportError as problem:
    print(problem)
    sys.exit(77)

with open(sys.argv[1], encoding="utf-8") as opened:
    task = json.load(opened)
points = np.array(task["points"], dtype=np.float64).reshape(-1, 1, 3)
zero = np.zeros(3)


def project(matrix, lens, is_fisheye):
    if is_fisheye:
        pixels, _ = cv2.fisheye.projectPoints(points, zero, zero, matrix, np.array(lens).reshape(4, 1))
    else:
        pixels, _ = cv2.projectPoints(points, zero, zero, matrix, np.array(lens))
    return pixels.reshape(-1, 2).tolist()


def numbers(node):
    return np.array([node.at(i).real() for i in range(node.size())])


def storage(name):
    """OpenCV's parser reads YAML of other programs once it has OpenCV's first line."""
    with open(name, encoding="utf-8") as opened:
        return cv2.FileStorage("%YAML:1.0\n---\n" + opened.read(), cv2.FileStorage_READ | cv2.FileStorage_MEMORY)


def opencv(name):
    file = cv2.FileStorage(name, cv2.FileStorage_READ)
    matrix = file.getNode("camera_matrix").mat()
    lens = file.getNode("distortion_coefficients").mat().ravel()
    size = [int(file.getNode(key).real()) for key in ("image_width", "image_height")]
    return size, project(matrix, lens, file.getNode("fisheye_model").real() == 1)


def ros(name):
    file = storage(name)
    matrix = numbers(file.getNode("camera_matrix").getNode("data")).reshape(3, 3)
    lens = numbers(file.getNode("distortion_coefficients").getNode("data"))
    model = file.getNode("distortion_model").string()
    assert model in ("plumb_bob", "rational_polynomial", "equidistant"), model
    projection = numbers(file.getNode("projection_matrix").getNode("data")).reshape(3, 4)
    assert (projection[:, :3] == matrix).all() and not projection[:, 3].any()
    size = [int(file.getNode(key).real()) for key in ("image_width", "image_height")]
    return size, project(matrix, lens, model == "equidistant")


def kalibr(name):
    file = storage(name)
    camera = file.getNode("cam0")
    assert camera.getNode("camera_model").string() == "pinhole"
    fx, fy, cx, cy = numbers(camera.getNode("intrinsics"))
    lens = numbers(camera.getNode("distortion_coeffs"))
    model = camera.getNode("distortion_model").string()
    assert model in ("radtan", "equidistant", "none"), model
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    lens = lens if len(lens) else np.zeros(4)
    size = [int(edge) for edge in numbers(camera.getNode("resolution"))]
    return size, project(matrix, lens, model == "equidistant")


def write(given):
    fx, fy, cx, cy = given["camera"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    file = cv2.FileStorage(given["file"], cv2.FileStorage_WRITE)
    file.write("calibration_time", "Wed 08 Dec 2021")
    file.write("image_width", given["size"][0])
    file.write("image_height", given["size"][1])
    if given["is_fisheye"]:
        file.write("fisheye_model", 1)
    file.write("camera_matrix", matrix)
    file.write("distortion_coefficients", np.array(given["lens"]).reshape(-1, 1))
    file.write("avg_reprojection_error", 0.25)
    file.release()
    return project(matrix, given["lens"], given["is_fisheye"])


readers = {"OpenCv": opencv, "Ros": ros, "Kalibr": kalibr}
read = [readers[given["format"]](given["file"]) for given in task["read"]]
written = [write(given) for given in task["write"]]
read = [{"size": size, "pixels": pixels} for size, pixels in read]
with open(sys.argv[2], "w", encoding="utf-8") as opened:
    json.dump({"read": read, "written": written}, opened)
