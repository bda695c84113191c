#!/usr/bin/env python3
"""Compares reference_drawings.txt with the pictures of the reference libraries; with --write it is written from them.

OpenCV (pip: opencv-python-headless) draws ArUco, AprilTag (pip: pyapriltags) its own families, both one pixel for each
cell. Cells that AprilTag's published pictures leave transparent are white here: cells that are neither bits nor one of the
rings of black and of white. A family whose library is not installed is not compared.
"""

import ctypes
import pathlib
import sys
import zlib

FILE = pathlib.Path(__file__).with_name("reference_drawings.txt")
APRILTAG = {
    "16h5": 1, "25h9": 1, "36h10": 1, "36h11": 1, "Circle21h7": 2, "Circle49h12": 3,
    "Custom48h12": 2, "Standard41h12": 2, "Standard52h13": 2,
}  # name: cells around the square that is detected


def aruco():
    """Yields each family's name and the bytes of all its pictures."""
    import cv2
    import numpy

    def pictures(name):
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, "DICT_" + name))
        for marker in range(len(dictionary.bytesList)):
            picture = dictionary.generateImageMarker(marker, dictionary.markerSize + 2, borderBits=1)
            yield numpy.pad(picture, 1, constant_values=255).tobytes()

    for side in (4, 5, 6, 7):
        for count in (50, 100, 250, 1000):
            yield f"aruco-{side}x{side}-{count}", pictures(f"{side}X{side}_{count}")
    yield "aruco-original", pictures("ARUCO_ORIGINAL")
    yield "aruco-mip-36h12", pictures("ARUCO_MIP_36h12")


class Family(ctypes.Structure):
    _fields_ = [
        ("ncodes", ctypes.c_uint32),
        ("codes", ctypes.POINTER(ctypes.c_uint64)),
        ("width_at_border", ctypes.c_int),
        ("total_width", ctypes.c_int),
        ("reversed_border", ctypes.c_bool),
        ("nbits", ctypes.c_uint32),
        ("bit_x", ctypes.POINTER(ctypes.c_uint32)),
        ("bit_y", ctypes.POINTER(ctypes.c_uint32)),
    ]


class Image(ctypes.Structure):
    _fields_ = [
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("stride", ctypes.c_int32),
        ("buf", ctypes.POINTER(ctypes.c_uint8)),
    ]


def apriltag():
    """Yields each family's name and the bytes of all its pictures."""
    import numpy
    import pyapriltags

    folder = pathlib.Path(pyapriltags.__file__).parent
    library = ctypes.CDLL(str(next(folder.glob("*apriltag*.*"))))
    library.apriltag_to_image.restype = ctypes.POINTER(Image)
    library.apriltag_to_image.argtypes = [ctypes.POINTER(Family), ctypes.c_uint32]

    def pictures(family, margin):
        side, width = family.total_width, family.width_at_border
        assert side == width + 2 * margin
        depth = numpy.minimum(numpy.arange(side), numpy.arange(side)[::-1]) - margin
        depth = numpy.minimum.outer(depth, depth)
        # The rings of white and black on both sides of the square's outline.
        meant = (depth == -1) | (depth == 0)
        for bit in range(family.nbits):
            x, y = (ctypes.c_int32(a[bit]).value + margin for a in (family.bit_x, family.bit_y))
            meant[y, x] = True
        for marker in range(family.ncodes):
            image = library.apriltag_to_image(family, marker).contents
            picture = numpy.ctypeslib.as_array(image.buf, (image.height, image.stride))[:, :side].copy()
            picture[~meant] = 255
            yield picture.tobytes()

    for name, margin in APRILTAG.items():
        create = getattr(library, f"tag{name}_create")
        create.restype = ctypes.POINTER(Family)
        yield f"apriltag-{name.lower()}", pictures(create().contents, margin)


def checksums():
    found = {}
    for families in (apriltag, aruco):
        try:
            for name, pictures in families():
                checksum = 0
                for picture in pictures:
                    checksum = zlib.crc32(picture, checksum)
                found[name] = f"{checksum:08x}"
        except ImportError as missing:
            print(f"skipped: {families.__name__}: {missing}")
    return found


def main():
    found = checksums()
    if "--write" in sys.argv:
        FILE.write_text("".join(f"{name} {found[name]}\n" for name in sorted(found)))
        return 0
    expected = dict(line.split() for line in FILE.read_text().splitlines())
    wrong = [name for name in found if found[name] != expected.get(name)]
    print(f"{len(found) - len(wrong)} families as in {FILE.name}; others: {', '.join(wrong) or 'none'}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
