# SPDX-License-Identifier: Apache-2.0
"""A textured blue ball before a wall: a class that moves leaves no features and depths in a map."""

from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest

from edge.config.features import OrbConfig
from edge.config.segmenter import SegmenterConfig
from edge.types import U8, Bools, Mat4
from maps.describe import Describer, Description
from maps.labels.looking import look_at
from maps.labels.moving import without_moving
from maps.learned import learned_layer, spec_of, survey_of
from maps.settings import BuildSettings
from maps.survey import Survey
from maps.views import ViewSet, choose_views
from maps.work_folder import work_folder
from maps.workers import open_workers
from tests.edge.changes.scenes import ball_detection
from tests.maps.drive_folder import KnownView, write_drive
from tests.maps.wall_drive import CAMERA, depth, picture, poses, wall
from tools.corner_model import make
from tools.key_colour_model import make_model
from tools.simworld.objects import KEY_COLOURS

CENTER, RADIUS_M = np.array([0.05, 0.05, 1.2]), 0.2

pytestmark = pytest.mark.slow


def _with_ball(grey: U8, T: Mat4) -> U8:
    image = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    inside = _ball(T)
    # Brighter and darker blue: corners that a map would like.
    light = np.where(wall(7)[: CAMERA.height, : CAMERA.width] > 128, 1.0, 0.75)
    colour = np.array(KEY_COLOURS["mug"]) * light[inside][:, None]
    image[inside] = np.clip(colour, 0, 255).astype(np.uint8)
    return np.asarray(image, np.uint8)


def _ball(T: Mat4) -> Bools:
    (mask,) = ball_detection([(0, CENTER, RADIUS_M)], T, CAMERA).masks
    h, w = mask.inside.shape
    inside = np.zeros((CAMERA.height, CAMERA.width), bool)
    inside[mask.top : mask.top + h, mask.left : mask.left + w] = mask.inside
    return inside


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> tuple[ViewSet, list[Description]]:
    folder = tmp_path_factory.mktemp("moving") / "wall"
    views = (KnownView(_with_ball(picture(wall(), T), T), T, depth(T)) for T in poses(2))
    drive = write_drive(folder, CAMERA, views, first_s=10.0)
    chosen = choose_views([drive], None, 1, frozenset())
    describer = Describer(chosen.roots, OrbConfig(), BuildSettings())
    return chosen, [describer.describe(view) for view in chosen.views]


def _on_ball(chosen: ViewSet, k: int, described: Description, grown_px: int = 0) -> tuple[int, int]:
    """Features and depths on the ball, and around it."""
    size = np.ones((2 * grown_px + 1, 2 * grown_px + 1), np.uint8)
    inside = cv2.dilate(_ball(chosen.views[k].T_map_cam).astype(np.uint8), size)
    counts = []
    for pixels in (described.features.raw_pixels, described.samples.pixels):
        column, row = np.rint(pixels).astype(int).T
        counts.append(int(inside[row, column].sum()))
    return counts[0], counts[1]


def test_what_moves_leaves_nothing_in_the_map_and_nothing_else_is_lost(
    described: tuple[ViewSet, list[Description]], tmp_path: Path
) -> None:
    model = tmp_path / "key.onnx"
    onnx.save(make_model(), model)
    chosen, before = described

    still = without_moving(before, chosen, look_at(model, SegmenterConfig(), chosen))
    seen = look_at(model, SegmenterConfig(moving=("mug",)), chosen)
    cleared = without_moving(before, chosen, seen)

    for k in range(len(before)):
        features, depths = _on_ball(chosen, k, before[k])
        assert min(features, depths) > 10
        assert still[k] is before[k]
        assert _on_ball(chosen, k, cleared[k]) == (0, 0)
        lost = len(before[k].features.pixels) - len(cleared[k].features.pixels)
        assert 0 < lost <= _on_ball(chosen, k, before[k], grown_px=12)[0]
        assert len(cleared[k].depth) == len(cleared[k].features.descriptors)
        assert cleared[k].words.words.size <= before[k].words.words.size


def test_nothing_of_it_is_in_the_features_of_a_model_either(
    described: tuple[ViewSet, list[Description]], tmp_path: Path
) -> None:
    segmenter, features = tmp_path / "key.onnx", make(tmp_path / "corners.onnx")
    onnx.save(make_model(), segmenter)
    chosen, before = described
    with open_workers(1, None) as crew, work_folder(tmp_path / "map") as work:
        own = survey_of(spec_of(features, OrbConfig()), Survey(OrbConfig(), crew, work))
        counts = []
        for moving in ("person", "mug"):
            seen = look_at(segmenter, SegmenterConfig(moving=(moving,)), chosen)
            layer = learned_layer(chosen, before, own, BuildSettings(), seen)
            seen_on = [_on_ball(chosen, k, d)[0] for k, d in enumerate(layer.content.descriptions)]
            counts.append(sum(seen_on))
    assert counts[0] > 10
    assert counts[1] == 0
