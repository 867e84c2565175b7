"""Pictures and films: hues, pixels of points in the plain scene, frames of films, and PNG files."""

import struct
import subprocess
import zlib

import numpy as np
from cases import CAMERA_HEIGHT, FOVY
from imageio_ffmpeg import get_ffmpeg_exe

HEIGHT, WIDTH = 120, 160
"""Size of most pictures, pixels."""


def has_colour(picture, rgba):
    """Return True for pixels with the hue of a colour: its channels are far above the others. (height, width)"""
    picture, is_high = picture.astype(int), np.asarray(rgba[:3]) > 0.5
    return picture[..., is_high].min(-1) > picture[..., ~is_high].max(-1) + 60


def pixel(point, height=HEIGHT, width=WIDTH):
    """Return row and column of a point in the picture of the plain scene's camera that looks straight down."""
    focal = 0.5 * height / np.tan(np.deg2rad(FOVY / 2))
    x, y, z = point
    return 0.5 * height - focal * y / (CAMERA_HEIGHT - z), 0.5 * width + focal * x / (CAMERA_HEIGHT - z)


def read_frames(path, height, width, *filters):
    """Return the frames of a film with this size after the filters of ffmpeg. (n, height, width, 3)"""
    decode = [get_ffmpeg_exe(), "-loglevel", "fatal", "-i", path, *filters, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    pixels = np.frombuffer(subprocess.run(decode, capture_output=True, check=True).stdout, np.uint8)
    return pixels[: len(pixels) // (height * width * 3) * height * width * 3].reshape(-1, height, width, 3)


def encode_png(pixels):
    """Return an image as the bytes of a PNG file: grey, (height, width), or coloured, (height, width, 3)."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + row.tobytes() for row in pixels.astype(np.uint8))
    head = struct.pack(">IIBBBBB", width, height, 8, 2 * (pixels.ndim - 2), 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
