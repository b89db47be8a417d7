#!/usr/bin/python3
# make_captures.py - writes scenes that are like captures of rooms, faces, objects and from drones, for docs/records/FIRST_VIEWS.md.
# SPDX-License-Identifier: Apache-2.0
"""make_captures.py FOLDER

Writes NAME.ply of each scene. Axes are right, down, forward. The bytes depend on this file alone.
"""
import math
import random
import struct
import sys
from pathlib import Path

LIGHT = (-0.48, -0.72, -0.50)
NAMES = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()


class Capture:
    def __init__(self):
        self.random, self.rows, self.n = random.Random(5), bytearray(), 0

    def between(self, low, high):
        return self.random.uniform(low, high)

    def direction(self):
        while True:
            v = [self.between(-1, 1) for _ in range(3)]
            if 0.01 < (length := math.hypot(*v)) <= 1:
                return [x / length for x in v]

    def add(self, mean, normal, scale, colour, flat=0.08, opacity=0.95):
        """A disc, shaded by its normal; `colour` is R, G, B of 0 to 1."""
        shade = 0.55 + 0.45 * max(0, sum(a * b for a, b in zip(normal, LIGHT))) + self.between(-0.05, 0.05)
        dc = [(max(0, min(1, shade * c)) - 0.5) / 0.28209479 for c in colour]
        # Turns z to the normal.
        q = (0, 1, 0, 0) if normal[2] < -0.999 else (1 + normal[2], -normal[1], normal[0], 0)
        q = [x / math.hypot(*q) for x in q]
        scales = [math.log(scale), math.log(scale), math.log(flat * scale)]
        self.rows += struct.pack("<14f", *mean, *dc, math.log(opacity / (1 - opacity)), *scales, *q)
        self.n += 1

    def box(self, middle, half, scale, n, colour, inwards=False, without=()):
        """Walls in proportion to their areas; `without`: (axis, side) of walls that are open."""
        walls = [(k, side) for k in range(3) for side in (-1, 1) if (k, side) not in without]
        areas = [half[(k + 1) % 3] * half[(k + 2) % 3] for k, _ in walls]
        for k, side in self.random.choices(walls, areas, k=n):
            p, normal = [self.between(-1, 1) for _ in range(3)], [0, 0, 0]
            p[k], normal[k] = side, -side if inwards else side
            at = [m + h * x for m, h, x in zip(middle, half, p)]
            self.add(at, normal, scale, colour(k, at) if callable(colour) else colour)

    def ball(self, middle, half, scale, n, colour, keep=lambda _: True):
        while n > 0:
            d = self.direction()
            if keep(d):
                self.add([m + h * x for m, h, x in zip(middle, half, d)], d, scale, colour(d) if callable(colour) else colour)
                n -= 1

    def ground(self, half, scale, n, colour):
        for _ in range(n):
            at = (self.between(-half, half), 0, self.between(-half, half))
            self.add(at, (0, -1, 0), scale, colour(at) if callable(colour) else colour)

    def floaters(self, radius, scale, n):
        for _ in range(n):
            r, d = self.between(0.5, 1.2) * radius, self.direction()
            self.add([r * x for x in d], (0, 0, 1), scale, (0.5, 0.5, 0.55), 1, 0.3)

    def write(self, path):
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {self.n}", *(f"property float {name}" for name in NAMES)]
        path.write_bytes("\n".join([*head, "end_header\n"]).encode() + self.rows)


def room(open_front=False):
    c = Capture()

    def wall(k, at):
        if k == 1:
            return (0.55, 0.38, 0.24) if at[1] > 0 else (0.92, 0.92, 0.9)
        is_window = k == 0 and at[0] > 0 and abs(at[1] + 0.2) < 0.7 and abs(at[2]) < 1
        return (0.75, 0.88, 1) if is_window else (0.86, 0.8, 0.68)

    c.box((0, 0, 0), (3, 1.5, 2.5), 0.06, 30000, wall, True, [(2, -1), (1, -1)] if open_front else ())
    c.box((1.6, 1.1, 1.4), (0.9, 0.4, 0.5), 0.035, 4000, (0.25, 0.4, 0.6))
    c.box((-2.2, 0.4, 1.9), (0.5, 1.1, 0.4), 0.035, 4000, (0.6, 0.42, 0.25))
    c.box((0, 1.15, -0.2), (0.6, 0.35, 0.4), 0.03, 3000, (0.8, 0.75, 0.7))
    c.ball((0.1, 0.65, -0.2), (0.15, 0.15, 0.15), 0.02, 800, (0.85, 0.3, 0.2))
    c.floaters(5, 0.3, 60)
    return c


def corridor():
    c = Capture()
    c.box((0, 0, 0), (1, 1.3, 9), 0.05, 40000, lambda k, at: ((0.5, 0.5, 0.55) if at[1] > 0 else (0.9, 0.9, 0.9)) if k == 1 else
          (0.45, 0.3, 0.2) if k == 0 and at[2] % 3 < 1 and at[1] > -0.8 else (0.85, 0.83, 0.75), True)
    for z in range(-7, 9, 4):
        c.box((0.7, 1, z), (0.25, 0.3, 0.7), 0.03, 2000, (0.25, 0.4, 0.6))
    return c


def face():
    """The front of a head, as by somebody who went round half of it."""
    c = Capture()

    def skin(d):
        x, y = d[0], d[1]
        if any(math.hypot((x - s) / 1.3, y + 0.16) < 0.09 for s in (-0.33, 0.33)):
            return (0.15, 0.1, 0.1)
        if abs(x) < 0.25 and abs(y - 0.42) < 0.04:
            return (0.7, 0.25, 0.25)
        return (0.25, 0.17, 0.1) if y < -0.55 else (0.9, 0.68, 0.55)

    c.ball((0, 0, 0), (0.8, 1.1, 0.95), 0.025, 22000, skin, lambda d: d[2] < 0.2)
    c.ball((0, 0.12, -0.95), (0.13, 0.25, 0.22), 0.015, 2500, (0.92, 0.66, 0.52), lambda d: d[2] < 0.2)
    c.ball((0, 1.75, 0.1), (1.4, 0.8, 0.6), 0.03, 12000, (0.2, 0.3, 0.5), lambda d: d[2] < 0.2)
    c.floaters(2, 0.15, 40)
    return c


def table():
    """An object on a table, before the walls of its room, all around but above."""
    c = Capture()
    c.box((0, 0.5, 0), (1.2, 0.05, 0.8), 0.02, 12000, (0.6, 0.42, 0.25))
    c.ball((0, 0.12, 0), (0.25, 0.33, 0.25), 0.012, 12000, lambda d: (0.2, 0.45, 0.75) if abs(d[1]) > 0.3 else (0.95, 0.93, 0.88))
    c.ball((0, -0.25, 0), (0.1, 0.1, 0.1), 0.01, 2000, (0.95, 0.93, 0.88))
    c.box((0, 0, 0), (4, 1.6, 4), 0.15, 6000, (0.7, 0.68, 0.62), True, [(1, -1)])
    return c


def object_before_sky():
    c = Capture()
    c.ball((0, 0, 0), (0.5, 0.8, 0.35), 0.015, 15000, lambda d: (0.75, 0.35, 0.25) if math.sin(9 * d[1]) > 0 else (0.95, 0.85, 0.6))
    c.ball((0, 0, 0), (60, 60, 60), 2.5, 3000, lambda d: (0.45, 0.6, 0.85) if d[1] < 0 else (0.35, 0.4, 0.3))
    return c


def drone(height=1.0, far=0):
    """Fields and houses from above; `far`: mountains around, as seen in the distance."""
    c = Capture()
    c.ground(100, 0.8, 40000, lambda at: (0.3, 0.3, 0.32) if abs(at[0]) < 3 or abs(at[2] - 20) < 3 else
             ((0.35, 0.55, 0.25), (0.6, 0.6, 0.3), (0.45, 0.5, 0.25))[int(at[0] // 33 + 2 * (at[2] // 40)) % 3])
    for _ in range(24):
        x, z, h, w, d = c.between(-85, 85), c.between(-85, 85), height * c.between(2, 7), c.between(4, 7), c.between(4, 7)
        c.box((x, -h, z), (w, h, d), 0.5, int(600 + 300 * height), lambda k, _: (0.7, 0.3, 0.22) if k == 1 else (0.9, 0.86, 0.78),
              without=[(1, 1)])
    for _ in range(60):
        x, z = c.between(-95, 95), c.between(-95, 95)
        c.ball((x, -4, z), (2.5, 3.5, 2.5), 0.5, 150, (0.2, 0.42, 0.18))
    if far:
        c.ball((0, 0, 0), (far, 0.25 * far, far), 0.02 * far, 4000, (0.55, 0.62, 0.72), lambda d: d[1] < 0.02)
    return c


def tower():
    c = Capture()
    c.ground(15, 0.25, 10000, (0.45, 0.5, 0.35))
    c.box((0, -10, 0), (1.5, 10, 1.5), 0.12, 20000, lambda k, at: (0.3, 0.35, 0.4) if at[1] % 2 < 0.8 and k != 1 else (0.8, 0.75, 0.65))
    c.ball((0, -21, 0), (2, 2, 2), 0.1, 4000, (0.35, 0.5, 0.45))
    return c


CAPTURES = {"room": room, "doll_house": lambda: room(True), "corridor": corridor, "face": face, "table": table,
            "sky": object_before_sky, "drone": drone, "mountains": lambda: drone(1, 400), "skyscrapers": lambda: drone(5), "tower": tower}

if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    for name, make in CAPTURES.items():
        make().write(Path(sys.argv[1]) / f"{name}.ply")
