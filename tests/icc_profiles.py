"""Color profiles for tests, built from published primaries, white points and tone curves (ICC.1:2001-04 format)."""

import itertools
import struct

import numpy as np

D50 = np.array([0.9642, 1.0, 0.8249])
D65, D50_XY = (0.3127, 0.3290), (0.3457, 0.3585)
#: Chromaticities of red, green and blue, white point, and gamma (0 for the curve of sRGB).
ADOBE_RGB = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), D65, 2.19921875)
DISPLAY_P3 = ((0.68, 0.32), (0.265, 0.69), (0.15, 0.06), D65, 0.0)
PROPHOTO = ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001), D50_XY, 1.8)
SRGB = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), D65, 0.0)
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def rgb_profile(red: tuple, green: tuple, blue: tuple, white: tuple, gamma: float) -> bytes:
    """Return a profile of an RGB space."""
    columns = np.stack([_xyz(xy) for xy in (red, green, blue)], axis=1)
    columns *= np.linalg.solve(columns, _xyz(white))
    cones, target = _BRADFORD @ _xyz(white), _BRADFORD @ D50
    columns = np.linalg.inv(_BRADFORD) @ np.diag(target / cones) @ _BRADFORD @ columns
    tags = {"wtpt": _xyz_tag(D50)}
    for name, column in zip("rgb", columns.T, strict=True):
        tags |= {f"{name}XYZ": _xyz_tag(column), f"{name}TRC": _curve_tag(gamma)}
    return _profile(b"mntr", b"RGB ", b"XYZ ", tags)


def gray_profile(gamma: float) -> bytes:
    """Return a profile of a gray space."""
    return _profile(b"mntr", b"GRAY", b"XYZ ", {"wtpt": _xyz_tag(D50), "kTRC": _curve_tag(gamma)})


def cmyk_profile(grid: int = 9) -> bytes:
    """Return a profile of imaginary inks, by a table of Lab values."""
    axis = np.linspace(0, 1, grid)
    table = [_lab_of_inks(*inks) for inks in itertools.product(axis, repeat=4)]
    ramp = struct.pack(">2H", 0, 65535)
    data = struct.pack(">4s4xBBBx9i2H", b"mft2", 4, 3, grid, *(65536 * np.eye(3, dtype=int)).ravel().tolist(), 2, 2)
    data += ramp * 4 + np.concatenate(table).astype(">u2").tobytes() + ramp * 3
    return _profile(b"prtr", b"CMYK", b"Lab ", {"wtpt": _xyz_tag(D50), "A2B0": data})


def with_float_steps(profile: bytes, steps: int) -> bytes:
    """Add a floating-point conversion (D2B0) of `steps` steps to a profile; each swaps red and green of the result."""
    matrix = struct.pack(">4s4xHH12f", b"matf", 3, 3, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0)
    place = struct.pack(">II", 16 + 8 * steps, len(matrix))  # all steps share one matrix
    data = struct.pack(">4s4xHHI", b"mpet", 3, 3, steps) + place * steps + matrix
    count = int.from_bytes(profile[128:132], "big")
    tags = [struct.unpack_from(">4sII", profile, 132 + 12 * index) for index in range(count)]
    body = profile[132 + 12 * count :]
    body += bytes(-len(body) % 4)
    tags = [(name, start + 12, size) for name, start, size in tags]
    tags.append((b"D2B0", 132 + 12 * len(tags) + 12 + len(body), len(data)))
    head = profile[4:128] + struct.pack(">I", count + 1) + b"".join(struct.pack(">4sII", *tag) for tag in tags)
    return struct.pack(">I", 4 + len(head) + len(body) + len(data)) + head + body + data


def _lab_of_inks(cyan: float, magenta: float, yellow: float, black: float) -> np.ndarray:
    """Return the Lab value of a mixture of inks, encoded in 16 bits: each ink absorbs its complement and some more."""
    paper = D50 * 0.9
    inks = {"c": (0.15, 0.25, 0.85), "m": (0.35, 0.18, 0.25), "y": (0.75, 0.8, 0.1), "k": (0.02, 0.02, 0.02)}
    xyz = paper.copy()
    for amount, passed in zip((cyan, magenta, yellow, black), inks.values(), strict=True):
        xyz *= 1 - amount + amount * np.array(passed)
    f = np.cbrt(xyz / D50)
    lab = np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])
    return np.clip(np.round([lab[0] * 652.8, (lab[1] + 128) * 256, (lab[2] + 128) * 256]), 0, 65535)


def _xyz(xy: tuple) -> np.ndarray:
    return np.array([xy[0] / xy[1], 1.0, (1 - xy[0] - xy[1]) / xy[1]])


def _xyz_tag(values: np.ndarray) -> bytes:
    return struct.pack(">4s4x3i", b"XYZ ", *(round(65536 * float(value)) for value in values))


def _curve_tag(gamma: float) -> bytes:
    if gamma:
        return struct.pack(">4s4xIH", b"curv", 1, round(gamma * 256))
    steps = np.linspace(0, 1, 1024)
    curve = np.where(steps <= 0.04045, steps / 12.92, ((steps + 0.055) / 1.055) ** 2.4)
    return struct.pack(">4s4xI", b"curv", len(curve)) + np.round(65535 * curve).astype(">u2").tobytes()


def _profile(kind: bytes, space: bytes, connection: bytes, tags: dict[str, bytes]) -> bytes:
    text = b"test"
    tags = {
        "desc": struct.pack(">4s4xI", b"desc", len(text) + 1) + text + bytes(1 + 4 + 4 + 2 + 1 + 67),
        "cprt": b"text" + bytes(4) + text + b"\0",
        **tags,
    }
    start = 128 + 4 + 12 * len(tags)
    table, body = struct.pack(">I", len(tags)), b""
    for name, data in tags.items():
        padded = data + bytes(-len(data) % 4)
        table += struct.pack(">4s2I", name.encode(), start + len(body), len(data))
        body += padded
    header = struct.pack(
        ">I4sI4s4s4s6H4s4s",
        start + len(body),
        b"",
        0x02100000,
        kind,
        space,
        connection,
        2026,
        1,
        1,
        0,
        0,
        0,
        b"acsp",
        b"",
    )
    header += struct.pack(">II4s8xI3i", 0, 0, b"", 0, *(round(65536 * value) for value in D50.tolist()))
    return header + bytes(128 - len(header)) + table + body
