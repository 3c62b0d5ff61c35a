# SPDX-License-Identifier: Apache-2.0
"""Draws where a calibration's corners lay, how far off they are, and what the lens does."""

import cv2
import numpy as np

from edge.runtime.calibrate import Calibration
from edge.runtime.calibration_views import covered
from edge.types import F64, U8

_WIDTH = 1000
_TEXT_HEIGHT = 70
_GAIN = 50.0  # residuals are drawn so many times larger
_EMPTY, _COVERED = (225, 215, 235), (250, 250, 250)
_GRID, _CORNER, _RESIDUAL, _INK = (190, 170, 140), (60, 140, 60), (50, 50, 210), (40, 40, 40)


def draw(found: Calibration, title: str) -> U8:
    """A picture (h, w, 3) uint8, blue first."""
    camera = found.camera
    scale = _WIDTH / camera.width
    height = round(camera.height * scale)
    canvas = np.full((height + _TEXT_HEIGHT, _WIDTH, 3), 255, np.uint8)
    _draw_cells(canvas[:height], found)
    _draw_lens(canvas[:height], found, scale)
    for view, residual in zip(found.views, found.result.residuals, strict=True):
        for at, error in zip(view.pixels, residual, strict=True):
            begin = _point(at, scale)
            cv2.line(canvas, begin, _point(at + _GAIN * error, scale), _RESIDUAL, 1, cv2.LINE_AA)
            cv2.circle(canvas, begin, 2, _CORNER, -1, cv2.LINE_AA)
    lines = (
        title,
        f"rms {found.result.rms_px:.3f} px, held out {found.held_out_px:.3f} px; red: errors x "
        f"{_GAIN:.0f}; shaded: no corner was there; lines: a straight grid as the lens shows it",
    )
    for number, line in enumerate(lines):
        at = (12, height + 28 + 26 * number)
        cv2.putText(canvas, line, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
    return canvas


def _draw_cells(canvas: U8, found: Calibration) -> None:
    cells = covered(found.views, found.camera.width, found.camera.height)
    colours = np.where(cells[..., None], _COVERED, _EMPTY).astype(np.uint8)
    size = (canvas.shape[1], canvas.shape[0])
    canvas[:] = cv2.resize(colours, size, interpolation=cv2.INTER_NEAREST)


def _draw_lens(canvas: U8, found: Calibration, scale: float) -> None:
    """Lines that are straight before an ideal camera."""
    camera = found.camera
    along = np.linspace(-1.0, 1.0, 80)
    reach = min(1.2 * camera.width / 2 / camera.fx, 0.98 * camera.field_limit)
    for offset in np.linspace(-1.0, 1.0, 17):
        for line in (
            np.stack((along, 0 * along + offset), 1),
            np.stack((0 * along + offset, along), 1),
        ):
            points = np.column_stack((reach * line, np.ones(len(line))))
            raw = camera.project(points)
            raw = raw[np.isfinite(raw).all(axis=1)]
            if len(raw) > 1:
                drawn = np.round(raw * scale).astype(np.int32).reshape(-1, 1, 2)
                cv2.polylines(canvas, [drawn], isClosed=False, color=_GRID, lineType=cv2.LINE_AA)


def _point(pixel: F64, scale: float) -> tuple[int, int]:
    return round(float(pixel[0]) * scale), round(float(pixel[1]) * scale)
