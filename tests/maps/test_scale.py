# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from edge.cameras.recording import Recording, open_recording
from edge.errors import ConfigError, RecordingError
from edge.geometry import se3, sim3, so3
from edge.geometry.sim3 import Sim3
from maps.scale import (
    Hint,
    Placed,
    check_chosen,
    of_depth,
    of_distance,
    of_marker,
    onto_poses,
    parse,
)
from maps.views import View
from tests.maps.posters import CAMERA, MARKER_SIDE_M, path, write_posters


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return open_recording(write_posters(tmp_path_factory.mktemp("walk") / "walk", 6))


def placed(recording: Recording, unit_m: float) -> list[Placed]:
    """The walk in a unit of its own."""
    S = Sim3(1.0 / unit_m, so3.exp([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    return [
        Placed(View(0, i, i, sim3.transform_pose(S, T), 0), CAMERA, recording)
        for i, T in enumerate(path(6))
    ]


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("given", Hint("given")),
        ("metres", Hint("metres")),
        ("depth", Hint("depth")),
        ("distance:3,40=1.25", Hint("distance", (3, 40), 1.25)),
        ("marker:4X4_50=0.16", Hint("marker", metres=0.16, family="4X4_50")),
    ],
)
def test_hints_are_read(text: str, hint: Hint) -> None:
    assert parse(text) == hint


@pytest.mark.parametrize(
    "text",
    [
        "", "big", "distance:1,2", "distance:1,1=2", "distance:1,2=0", "distance:1,2=nan",
        "distance:-1,2=3", "distance:1,2=1e9", "distance:1,2=-", "marker:4X4_50", "marker:4X4_50=x",
    ],
)  # fmt: skip
def test_other_hints_are_refused_with_their_forms(text: str) -> None:
    with pytest.raises(ConfigError, match="says no scale; give given, metres"):
        parse(text)


def test_an_unknown_marker_family_is_named() -> None:
    with pytest.raises(ConfigError, match="BIG_ONE"):
        parse("marker:BIG_ONE=0.2")


def test_a_distance_between_cameras(recording: Recording) -> None:
    walk = placed(recording, 3.5)
    T = path(6)
    metres = float(np.linalg.norm(T[0, :3, 3] - T[4, :3, 3]))
    assert of_distance(Hint("distance", (0, 4), metres), walk) == pytest.approx(3.5)
    with pytest.raises(RecordingError, match="image 9 is not among"):
        of_distance(Hint("distance", (0, 9), 1.0), walk)
    walk[1] = walk[1]._replace(view=walk[0].view._replace(image=1))
    with pytest.raises(RecordingError, match="nearly the same place"):
        of_distance(Hint("distance", (0, 1), 1.0), walk)


def test_the_sides_of_a_marker(recording: Recording) -> None:
    hint = Hint("marker", metres=MARKER_SIDE_M, family="4X4_50")
    # Corners are 0.1 px off, of sides of 40 px.
    assert of_marker(hint, placed(recording, 3.5)) == pytest.approx(3.5, rel=0.01)
    with pytest.raises(RecordingError, match="no marker of the family 6X6_50"):
        of_marker(hint._replace(family="6X6_50"), placed(recording, 3.5))
    with pytest.raises(RecordingError, match="seen from two sides"):
        of_marker(hint, placed(recording, 3.5)[:1])


def test_depths_tell_the_unit_whatever_a_third_of_them_say() -> None:
    rng = np.random.default_rng(0)
    reckoned = rng.uniform(1.0, 5.0, 300)
    measured = 2.5 * reckoned * np.exp(rng.normal(0.0, 0.01, 300))
    measured[::4] = 0.0
    measured[1::6] *= 3.0
    assert of_depth(measured, reckoned) == pytest.approx(2.5, rel=0.005)
    with pytest.raises(RecordingError, match="only 40 points"):
        of_depth(measured[reckoned > 0][:40] + 1.0, reckoned[:40])
    with pytest.raises(RecordingError, match="disagree"):
        of_depth(rng.uniform(1.0, 9.0, 300), reckoned)


@pytest.mark.parametrize("on_a_line", [False, True])
def test_poses_are_taken_onto_true_ones(on_a_line: bool) -> None:
    rng = np.random.default_rng(1)
    S = Sim3(0.4, so3.exp([0.5, -1.0, 2.0]), np.array([3.0, -2.0, 1.0]))
    poses = [se3.exp(rng.normal(0.0, 1.0, 6)) for _ in range(9)]
    for i, T in enumerate(poses):
        if on_a_line:
            T[:3, 3] = 0.3 * i, 0.0, 0.0
    found = onto_poses(poses, [sim3.transform_pose(S, T) for T in poses])
    assert found.s == pytest.approx(S.s)
    np.testing.assert_allclose(found.R, S.R, atol=1e-9)
    np.testing.assert_allclose(found.t, S.t, atol=1e-9)


def test_true_poses_that_do_not_fit_are_refused() -> None:
    rng = np.random.default_rng(1)
    poses = [se3.exp(rng.normal(0.0, 1.0, 6)) for _ in range(9)]
    others = [se3.exp(rng.normal(0.0, 1.0, 6)) for _ in range(9)]
    with pytest.raises(RecordingError, match="do not fit"):
        onto_poses(poses, others)
    with pytest.raises(RecordingError, match="do not fit"):
        onto_poses(poses, [np.eye(4)] * 9)
    with pytest.raises(RecordingError, match="fewer than two"):
        onto_poses(poses[:1], poses[:1])


def test_an_image_that_is_left_out_is_refused_with_the_nearest_that_is_not() -> None:
    hint = Hint("distance", (0, 10), 1.0)
    check_chosen(hint, [0, 5, 10])
    with pytest.raises(RecordingError, match=r"image 10 .* nearest of them is 8"):
        check_chosen(hint, [0, 8, 16])
