# SPDX-License-Identifier: Apache-2.0
"""What the odometry is measured on, what is asked of it, and what the reference DSO did there."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from edge.types import U8, Frame

Spoil = Callable[[int, U8], U8]  # place in the play, image

# Arguments of `python -m tools.simworld`; a change of them needs a new name.
WORLDS = {
    "sim walk": "--seed 11 --seconds 10 --rate 30",
    "sim corridor": "--seed 12 --room corridor --seconds 12 --rate 30",
    # A Kinect's colour camera: rows are read over 27 of the 33 ms; noise, blur, auto-exposure.
    "sim kinect": "--seed 13 --seconds 10 --rate 30 --rolling-ms 27 --blur-ms 8 --noise 4 "
    "--vignette 0.2",
    "sim exposure": "--seed 14 --seconds 10 --rate 30 --exposure steps --noise 2",
    "sim lens": "--seed 15 --seconds 10 --rate 30 --distortion radtan:-0.25,0.07,0.0005,-0.0003",
}


def as_it_is(n: int, image: U8) -> U8:
    """The image itself."""
    return image


def flicker(n: int, image: U8) -> U8:
    """Gain of e^+-0.4 over 23 frames, offset of 8 grey over 31."""
    gain = math.exp(0.4 * math.sin(2.0 * math.pi * n / 23))
    offset = 8.0 * math.sin(2.0 * math.pi * n / 31)
    return np.clip(gain * image.astype(np.float64) + offset, 0, 255).astype(np.uint8)


def noise(n: int, image: U8) -> U8:
    """White noise of 8 grey."""
    rng = np.random.default_rng(n)
    return np.clip(np.rint(image + rng.normal(0.0, 8.0, image.shape)), 0, 255).astype(np.uint8)


def blur(n: int, image: U8) -> U8:
    """Out of focus by 2 px."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), np.uint8)


@dataclass(frozen=True)
class Case:
    """One way to play one recording."""

    name: str
    recording: str  # folder below --data, or one of WORLDS
    start: int = 0
    stride: int = 1
    reverse: bool = False
    spoil: Spoil = as_it_is
    bounds_cm: tuple[float, float] | None = None  # lean, fine
    bound_share: float | None = None  # of the path, in its place

    def folder(self, data: Path, worlds: Path) -> Path:
        """Where its recording lies."""
        if self.recording in WORLDS:
            return worlds / self.recording.replace(" ", "_")
        return data / self.recording

    def change(self, n: int, frame: Frame) -> Frame:
        """The n-th frame of the play as it is shown to the odometry."""
        return replace(frame, image=self.spoil(n, frame.image))

    def bound_cm(self, preset: str, path_m: float | None) -> float | None:
        """What the RMSE may be."""
        if self.bound_share is not None and path_m is not None:
            return 100.0 * self.bound_share * path_m
        return None if self.bounds_cm is None else self.bounds_cm[preset == "fine"]


RK = "redkitchen"
CASES = (
    *(Case(f"{RK}@{s}", RK, s, bounds_cm=(2.6, 2.2)) for s in (0, 10, 25, 50, 100, 150, 200)),
    Case(f"{RK} reversed", RK, reverse=True, bounds_cm=(3.0, 3.0)),
    *(Case(f"{RK}@50 stride {k}", RK, 50, k, bounds_cm=(k + 1.0, k + 1.0)) for k in (2, 3, 4)),
    Case(f"{RK}@50 flicker", RK, 50, spoil=flicker, bounds_cm=(4.0, 4.0)),
    Case(f"{RK}@50 noise", RK, 50, spoil=noise),
    Case(f"{RK}@50 blur", RK, 50, spoil=blur),
    Case("kitti_turn", "kitti_turn", bound_share=0.015),
    Case("icl_office_kt0", "icl_office_kt0", bounds_cm=(0.5, 0.5)),
    Case("office/query", "office/query", bounds_cm=(0.5, 0.5)),
    Case("icsl_corridor", "icsl_corridor"),
    *(Case(name, name) for name in WORLDS),
)

# The reference DSO in C++ (preset 2: 800 points at 424x320; preset 0: 2000 at 640x480), CPU time on
# one core of a 2 vCPU AMD EPYC, gcc 12 -O3 -march=native; from the project's anchor measurements.
DSO = {
    "lean": {
        f"{RK}@0": "30.4, 483/500, 16.0, 2.6 / 61, 107",
        f"{RK}@10": "26.8, 477/490, 16, 2.5 / 60, 105",
        f"{RK}@25": "2.6, 464/475, 16, 2.5 / 59, 106",
        f"{RK}@50": "1.8, 442/450, 16, 2.5 / 59, 106",
        f"{RK}@100": "1.9, 391/400, 17, 2.8 / 60, 107",
        f"{RK}@150": "1.7, 341/350, 19, 3.1 / 70, 106",
        f"{RK}@200": "1.7, 291/300, 17, 2.5 / 60, 106",
        f"{RK} reversed": "21-27",
        f"{RK}@50 stride 2": "no reset",
        f"{RK}@50 stride 3": "1 reset",
        f"{RK}@50 stride 4": "3 resets",
        f"{RK}@50 flicker": "38-42, 2-8 resets",
        "kitti_turn": "never starts",
        "icl_office_kt0": "2.5",
        "office/query": "0.33, 291/300, -, 3.1 / 66",
        "icsl_corridor": "208/220",
    },
    "fine": {
        f"{RK}@0": "27.8, 484/500, 47, 7.2 / 224, 164",
        f"{RK}@50": "2.6, 442/450, 47, 7.6 / 223, 165",
        "kitti_turn": "never starts",
        "icl_office_kt0": "7.0",
        "office/query": "0.25",
    },
}
