"""Writes the JPEG files next to it with OpenCV: a grained picture of rings on paper, in colour and grey, with and without restart
intervals. OpenCV's encoder is libjpeg-turbo, with the standard Huffman tables."""

import pathlib

import cv2
import numpy as np

FOLDER = pathlib.Path(__file__).parent
SIZE = (149, 117)
QUALITY = 80
FILES = {
    "colour-420": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420, 0),
    "colour-420-restarts": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420, 4),
    "colour-444": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444, 0),
    "colour-444-restarts": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444, 7),
    "grey": (None, 0),
    "grey-restarts": (None, 19),
}


def picture():
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    ground = np.stack([70 + 0.3 * x, 110 + 0.4 * y, 90 + 0.2 * (x + y)], axis=-1)
    ground += np.random.default_rng(1).normal(0, 9, ground.shape)
    for radius, shade in ((44, 225), (36, 25), (24, 225), (11, 25)):
        ground[np.hypot(x - 70, y - 58) < radius] = shade
    return cv2.GaussianBlur(np.clip(ground, 0, 255).astype(np.uint8), (0, 0), 0.6)


colour = picture()
grey = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
for name, (sampling, interval) in FILES.items():
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_RST_INTERVAL, interval]
    if sampling is not None:
        options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    cv2.imwrite(str(FOLDER / f"{name}.jpg"), grey if sampling is None else colour, options)
