import pytest

from edge.cameras.oak_calibration import camera_from_device
from edge.errors import CameraRefused

K = [[400.0, 0.0, 319.0], [0.0, 402.0, 199.0], [0.0, 0.0, 1.0]]
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
        ("Perspective", [*K1_TO_K6, 1e-5, *[0.0] * 5], "thin-prism or tilt"),
        ("Perspective", [*K1_TO_K6, *[0.0] * 5, 1e-3], "thin-prism or tilt"),
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
