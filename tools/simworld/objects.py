# SPDX-License-Identifier: Apache-2.0
"""Small things. Four kinds wear saturated key colours, which no other surface reaches."""

import math
from collections.abc import Callable

import numpy as np

from tools.simworld.furniture import BLACK, GREY, box, cylinder, ellipsoid, picture
from tools.simworld.noise import Bgr
from tools.simworld.world import Material, Part, Texture, Vec

KEY_COLOURS: dict[str, Bgr] = {
    "ball": (25.0, 25.0, 225.0),
    "mug": (225.0, 70.0, 20.0),
    "carton": (30.0, 200.0, 30.0),
    "figurine": (215.0, 25.0, 215.0),
}


def _key(label: str) -> Material:
    return Material(Texture("plain", KEY_COLOURS[label], 5, (64, 64)))


def _muted(rng: np.random.Generator, low: float, high: float) -> Bgr:
    """A colour whose brightness lies between the bounds, far from the key colours."""
    b, g, r = rng.uniform(low, high) * rng.uniform(0.6, 1.3, 3)
    return float(b), float(g), float(r)


def ball(rng: np.random.Generator) -> list[Part]:
    """A red ball of 10 to 18 cm."""
    r = float(rng.uniform(0.05, 0.09))
    return [ellipsoid((r, r, r), (0, 0, r), _key("ball"))]


def mug(rng: np.random.Generator) -> list[Part]:
    """A blue mug with a handle, dark inside."""
    r, h = float(rng.uniform(0.038, 0.046)), float(rng.uniform(0.085, 0.12))
    blue = _key("mug")
    return [
        cylinder(r, h, (0, 0, 0.5 * h), blue),
        cylinder(0.82 * r, 0.002, (0, 0, h + 0.001), BLACK),
        box((0.012, 0.012, 0.6 * h), (r + 0.022, 0, 0.5 * h), blue),
        box((0.03, 0.012, 0.012), (r + 0.01, 0, 0.76 * h), blue),
        box((0.03, 0.012, 0.012), (r + 0.01, 0, 0.24 * h), blue),
    ]


def carton(rng: np.random.Generator) -> list[Part]:
    """A green packet."""
    w, d, h = (float(v) for v in rng.uniform((0.10, 0.07, 0.12), (0.22, 0.14, 0.26)))
    return [box((w, d, h), (0, 0, 0.5 * h), _key("carton"))]


def figurine(rng: np.random.Generator) -> list[Part]:
    """A magenta figure: feet, body, head, ears."""
    s = float(rng.uniform(0.8, 1.2))
    pink = _key("figurine")
    return [
        ellipsoid((0.05 * s, 0.045 * s, 0.06 * s), (0, 0, 0.06 * s), pink),
        ellipsoid((0.04 * s, 0.04 * s, 0.04 * s), (0, 0, 0.145 * s), pink),
        ellipsoid((0.012 * s, 0.012 * s, 0.03 * s), (0.022 * s, 0, 0.195 * s), pink),
        ellipsoid((0.012 * s, 0.012 * s, 0.03 * s), (-0.022 * s, 0, 0.195 * s), pink),
        ellipsoid((0.03 * s, 0.045 * s, 0.014 * s), (0.03 * s, -0.03 * s, 0.014 * s), pink),
        ellipsoid((0.03 * s, 0.045 * s, 0.014 * s), (-0.03 * s, -0.03 * s, 0.014 * s), pink),
    ]


def book(rng: np.random.Generator) -> list[Part]:
    """Two or three books lying on one another."""
    parts, z = [], 0.0
    for _ in range(int(rng.integers(2, 4))):
        w, d = float(rng.uniform(0.15, 0.21)), float(rng.uniform(0.2, 0.27))
        h = float(rng.uniform(0.015, 0.045))
        tone = _muted(rng, 60, 190)
        cover = picture("poster", tone, int(rng.integers(1 << 30)), (256, 256))
        back = picture("spine", tone, int(rng.integers(1 << 30)), (64, 256))
        turn = float(rng.normal(0, 0.25))
        parts.append(box((w, d, h), (0, 0, z + 0.5 * h), cover, {2: back, 3: back}, turn))
        z += h
    return parts


def screen(rng: np.random.Generator) -> list[Part]:
    """A monitor on a foot, its picture towards -y."""
    w = float(rng.uniform(0.46, 0.6))
    h = 0.58 * w
    tone = _muted(rng, 50, 150)
    content = picture("screen", tone, int(rng.integers(1 << 30)))
    face = Material(content.texture, None, False, 0.95)
    return [
        box((w, 0.035, h), (0, 0, 0.13 + 0.5 * h), BLACK, {2: face}),
        box((0.05, 0.03, 0.2), (0, 0.03, 0.1), BLACK),
        box((0.22, 0.16, 0.012), (0, 0.02, 0.006), BLACK),
    ]


def laptop(rng: np.random.Generator) -> list[Part]:
    """An open laptop facing -y."""
    keys = picture("keyboard", (120.0, 120.0, 122.0), int(rng.integers(1 << 30)), (256, 512))
    content = picture("screen", (120.0, 90.0, 60.0), int(rng.integers(1 << 30)))
    face = Material(content.texture, None, False, 0.95)
    lid = box((0.33, 0.012, 0.22), (0, 0.15, 0.12), GREY, {2: face}, 0.0, -0.3)
    return [box((0.33, 0.23, 0.018), (0, 0, 0.009), GREY, {5: keys}), lid]


def keyboard(rng: np.random.Generator) -> list[Part]:
    """A keyboard."""
    dark = float(rng.choice([45.0, 205.0]))
    keys = picture("keyboard", (dark, dark, dark), int(rng.integers(1 << 30)), (256, 512))
    return [box((0.43, 0.14, 0.02), (0, 0, 0.01), keys, {0: GREY, 1: GREY, 2: GREY, 3: GREY})]


def papers(rng: np.random.Generator) -> list[Part]:
    """Some printed sheets, not quite on one another."""
    parts = []
    for i in range(int(rng.integers(1, 4))):
        sheet = picture("document", (236.0, 238.0, 238.0), int(rng.integers(1 << 30)), (512, 512))
        at = (*(float(v) for v in np.clip(rng.normal(0, 0.03, 2), -0.04, 0.04)), 0.001 + 0.002 * i)
        middle: Vec = (at[0], at[1], at[2])
        parts.append(box((0.21, 0.297, 0.002), middle, sheet, None, float(rng.normal(0, 0.5))))
    return parts


def parcel(rng: np.random.Generator) -> list[Part]:
    """A brown corrugated box with a label."""
    w, d, h = (float(v) for v in rng.uniform((0.28, 0.22, 0.2), (0.5, 0.38, 0.38)))
    board = picture("carton", (95.0, 140.0, 172.0), int(rng.integers(1 << 30)))
    return [box((w, d, h), (0, 0, 0.5 * h), board)]


def desk_lamp(rng: np.random.Generator) -> list[Part]:
    """A foot, two arms and a shade."""
    a = float(rng.uniform(0.2, 0.5))
    return [
        cylinder(0.08, 0.02, (0, 0, 0.01), BLACK),
        box((0.014, 0.014, 0.34), (0, -0.17 * math.sin(a), 0.17 * math.cos(a)), BLACK, tilt=a),
        cylinder(0.06, 0.09, (0, -0.34 * math.sin(a), 0.34 * math.cos(a)), GREY),
    ]


def can(rng: np.random.Generator) -> list[Part]:
    """A tin with a printed label, or a pen holder."""
    tone = _muted(rng, 70, 190)
    label = picture("poster", tone, int(rng.integers(1 << 30)), (256, 512))
    return [cylinder(0.04, 0.11, (0, 0, 0.055), label, {5: GREY})]


OBJECTS: dict[str, Callable[[np.random.Generator], list[Part]]] = {
    "ball": ball, "mug": mug, "carton": carton, "figurine": figurine, "book": book,
    "screen": screen, "laptop": laptop, "keyboard": keyboard, "papers": papers,
    "parcel": parcel, "lamp": desk_lamp, "can": can,
}  # fmt: skip
