# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from edge.cameras.oak_calibration import camera_from_device
from edge.errors import CameraRefused
from edge.geometry.camera import CameraModel

K = [[400.0, 0.0, 319.0], [0.0, 402.0, 199.0], [0.0, 0.0, 1.0]]
PRISM = [
    -0.2,
    0.05,
    0.001,
    -0.002,
    -0.01,
    0.1,
    0.02,
    0.01,
    1.5e-4,
    -5e-5,
    1e-4,
    3e-5,
    0.002,
    -0.003,
]
K1_TO_K6 = [-0.1, 0.02, 0.001, -0.002, 0.003, 0.4, 0.5, 0.6]


@pytest.mark.parametrize(
    ("model", "given", "carried"),
    [
        ("Perspective", [*K1_TO_K6, *[0.0] * 6], ("radtan", tuple(K1_TO_K6))),
        ("Perspective", [*K1_TO_K6[:5], *[0.0] * 9], ("radtan", tuple(K1_TO_K6[:5]))),
        ("Perspective", [*K1_TO_K6[:4], *[0.0] * 10], ("radtan", tuple(K1_TO_K6[:4]))),
        ("Perspective", K1_TO_K6[:5], ("radtan", tuple(K1_TO_K6[:5]))),
        ("Perspective", [0.0] * 14, ("none", ())),
        ("Fisheye", [0.1, 0.2, 0.3, 0.4], ("equidistant", (0.1, 0.2, 0.3, 0.4))),
        ("Fisheye", [0.1, 0.2, 0.3, 0.4, *[0.0] * 10], ("equidistant", (0.1, 0.2, 0.3, 0.4))),
    ],
)
def test_lens_models_are_carried(
    model: str, given: list[float], carried: tuple[str, tuple[float, ...]]
) -> None:
    camera = camera_from_device(model, K, given, 640, 400)
    assert (camera.distortion_model, camera.distortion) == carried
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (400.0, 402.0, 319.0, 199.0)


@pytest.mark.parametrize(
    ("model", "given", "match"),
    [
        ("Perspective", [*PRISM[:8], 0.02, 0.0, 0.05, *[0.0] * 3], "thin-prism and tilt.*px off"),
        ("Perspective", K1_TO_K6[:6], "has 6 lens terms"),
        ("RadialDivision", [0.1], "lens model RadialDivision is not carried"),
        ("Cylindrical", [], "lens model Cylindrical is not carried"),
        ("Fisheye", [0.1, 0.2], "no whole fisheye"),
    ],
)
def test_others_are_refused_with_a_way_out(model: str, given: list[float], match: str) -> None:
    with pytest.raises(CameraRefused, match=f"{match}.*mapvo calibrate"):
        camera_from_device(model, K, given, 640, 400)


def test_intrinsics_that_make_no_sense_are_refused() -> None:
    with pytest.raises(CameraRefused, match="fx: 0 is impossible"):
        camera_from_device("Fisheye", [[0.0] * 3] * 3, [0.0] * 4, 640, 400)


def test_thin_prism_and_tilt_terms_that_hardly_matter_are_taken_up_by_the_others() -> None:
    camera = camera_from_device("Perspective", K, PRISM, 640, 400)
    assert camera.distortion_model == "radtan"
    assert len(camera.distortion) == 8
    u, v = np.meshgrid(np.linspace(-0.7, 0.7, 9), np.linspace(-0.4, 0.4, 7))
    rays = np.column_stack((u.ravel(), v.ravel(), np.ones(u.size)))
    raw = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.array(K), np.array(PRISM))[0]
    plain = CameraModel(640, 400, 400.0, 402.0, 319.0, 199.0, "radtan", tuple(PRISM[:8]))
    assert _worst_angle(camera, raw.reshape(-1, 2), rays) * 400.0 < 0.2  # [px]
    assert _worst_angle(plain, raw.reshape(-1, 2), rays) * 400.0 > 0.5  # left out, they matter


def _worst_angle(camera: CameraModel, pixels: np.ndarray, rays: np.ndarray) -> float:
    """Largest error [rad] of the angles between rays, which no turn of the camera changes."""
    seen = np.column_stack((camera.normalise(camera.undistort_pixels(pixels)), rays[:, 2]))
    cosines = [
        unit @ unit.T
        for unit in (a / np.linalg.norm(a, axis=1, keepdims=True) for a in (seen, rays))
    ]
    angles = [np.arccos(np.clip(c, -1.0, 1.0)) for c in cosines]
    return float(np.abs(angles[0] - angles[1]).max())
