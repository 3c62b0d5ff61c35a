# SPDX-License-Identifier: Apache-2.0
"""A drive followed by lines alone: those of every other image, at true poses, are the map."""

import time

import numpy as np

from edge.cameras.recording import Recording
from edge.config.lines import PairingConfig, SegmentConfig, SegmentTracksConfig
from edge.geometry import se3
from edge.lines.detector import SegmentDetector
from edge.lines.guided import localise
from edge.lines.tracks import SegmentTracks
from edge.types import Mat4

_MAX_APART_NS = 20_000_000


def follow(recording: Recording) -> str:
    """One line of a table: share tracked, errors, time; for ideal cameras with true poses."""
    if recording.groundtruth is None or recording.camera.distortion_model != "none":
        return "no true poses, or a lens"
    t_ns, T_world_cam = recording.groundtruth
    truth = []
    for index in recording.indices:
        nearest = int(np.argmin(np.abs(t_ns - recording.t_ns[index])))
        if abs(int(t_ns[nearest] - recording.t_ns[index])) > _MAX_APART_NS:
            return "images without a true pose"
        truth.append((int(index), se3.inverse(T_world_cam[nearest])))
    camera = recording.camera.pinhole
    detector = SegmentDetector(SegmentConfig())
    tracks = SegmentTracks(camera, SegmentTracksConfig(reach_px=20.0))
    for index, T in truth[::2]:
        tracks.step(detector.detect(np.asarray(recording.image(index))), T)
    found = tracks.structure()
    off_cm, cost_ms, pairs = [], [], []
    before, guess = None, truth[1][1]
    for index, T in truth[1::2]:
        image = np.asarray(recording.image(index))
        began = time.process_time()
        segments = detector.detect(image)
        here = localise(found.lines, found.span, segments, camera, guess, PairingConfig())
        cost_ms.append(1e3 * (time.process_time() - began))
        if here is None:
            before = None
            continue
        now = here.pose.T_cam_lines
        off_cm.append(100.0 * np.linalg.norm(_place(now) - _place(T)))
        pairs.append(int(here.agree.sum()))
        guess = now if before is None else now @ se3.inverse(before) @ now
        before = now
    if not off_cm:
        return f"{len(found.span)} lines, no image found"
    return (
        f"{len(found.span)} lines; {len(off_cm)}/{len(truth[1::2])} images by lines alone, off by"
        f" {np.median(off_cm):.2f} cm (p95 {np.quantile(off_cm, 0.95):.2f}, max"
        f" {max(off_cm):.2f}), {np.median(pairs):.0f} pairs, {np.median(cost_ms):.1f} ms an image"
    )


def _place(T_cam_lines: Mat4) -> np.ndarray:
    """Where the camera is, (3,)."""
    return np.asarray(se3.inverse(T_cam_lines)[:3, 3])
