# SPDX-License-Identifier: Apache-2.0
"""The process that runs COLMAP: `python -m maps.sfm.child FOLDER`, with a job in the folder.

It ends by itself in the middle of its work where COLMAP finds something it did not expect, which is
why it is a process. It writes lines `STAGE DONE TOTAL` to its standard output, and a last line
`error WHY` with status 2 where a person can do something.
"""

import ctypes
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.errors import EdgeError, RecordingError
from edge.types import F32, U8
from maps.sfm import job as job_file
from maps.sfm.halves import confirm_lenses
from maps.sfm.job import Job, may_refine, to_colmap

_PR_SET_PDEATHSIG = 1
_SEED = 1
# More give no better poses, and matching takes the square of their number.
_FEATURES = 2000
_MAX_SIDE_PX = 1600  # larger images are made smaller
# Fewer matches are chance.
_MIN_MATCHES = 15
_MIN_MODEL = 3
_LOG_ERRORS_ONLY = 2

Say = Callable[[str, int, int], None]


def run(folder: Path, say: Say) -> None:
    """Do the job in the folder; the models lie in folders 0, 1, ... of `MODELS` then."""
    colmap = _colmap()
    job = job_file.read(folder)
    database = folder / job_file.DATABASE
    with_features = _write_features(colmap, job, database, say)
    _match(colmap, job, folder, with_features, say)
    _reconstruct(colmap, job, folder, say)


def _colmap() -> Any:  # a module without types that are of use
    try:
        import pycolmap
    except ImportError:
        message = "pycolmap is missing, which --poses sfm needs; pip install 'mapvo[maps]'"
        raise RecordingError(message) from None
    pycolmap.logging.minloglevel = _LOG_ERRORS_ONLY
    pycolmap.set_random_seed(_SEED)
    return pycolmap


def name_of(photo: int) -> str:
    """What an image is called in the database; pairs are named by text without blanks."""
    return f"{photo:08d}"


def _write_features(colmap: Any, job: Job, path: Path, say: Say) -> list[bool]:
    """Fill the database with cameras, images and their features; tell which have some."""
    database = colmap.Database.open(path)
    sensors = [_write_camera(colmap, database, job, number) for number in range(len(job.cameras))]
    found = []
    for photo, (pixels, descriptors) in enumerate(_features(colmap, job)):
        place = job.photos[photo]
        image = colmap.Image(
            name=name_of(photo), camera_id=sensors[place.camera], image_id=photo + 1
        )
        database.write_image(image, use_image_id=True)
        frame = colmap.Frame(rig_id=sensors[place.camera], frame_id=photo + 1)
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
        database.write_keypoints(photo + 1, pixels)
        database.write_descriptors(photo + 1, descriptors)
        found.append(len(pixels) >= _MIN_MATCHES)
        say("features", photo + 1, len(job.photos))
    database.close()
    return found


def _write_camera(colmap: Any, database: Any, job: Job, number: int) -> int:
    camera = job.cameras[number]
    model = colmap.Camera(
        model="SIMPLE_RADIAL" if may_refine(job, number) else "SIMPLE_PINHOLE",
        width=camera.width,
        height=camera.height,
        params=[camera.fx, camera.cx + 0.5, camera.cy + 0.5, 0.0][: 3 + may_refine(job, number)],
        camera_id=number + 1,
    )
    model.has_prior_focal_length = True
    database.write_camera(model, use_camera_id=True)
    rig = colmap.Rig(rig_id=number + 1)
    rig.add_ref_sensor(model.sensor_id)
    database.write_rig(rig, use_rig_id=True)
    return number + 1


def _features(colmap: Any, job: Job) -> Iterator[tuple[F32, Any]]:
    """Pixels (n, 2) for COLMAP and descriptors of each photo."""
    options = colmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.use_gpu = False
    options.sift.max_num_features = _FEATURES
    extractor = colmap.FeatureExtractor.create(options, device=colmap.Device.cpu)
    recordings: dict[str, Recording] = {}
    for place in job.photos:
        if place.root not in recordings:
            recordings[place.root] = open_recording(place.root)
        image = recordings[place.root].needed_image(place.image)
        smaller, scale = _shrunk(image)
        keypoints, descriptors = extractor.extract_from_uint8_array(smaller)
        raw = colmap.keypoints_to_matrix(keypoints)[:, :2] / scale - 0.5
        pixels = to_colmap(job.cameras[place.camera], raw).astype(np.float32)
        kept = np.isfinite(pixels).all(axis=1)
        yield np.ascontiguousarray(pixels[kept]), _rows(colmap, descriptors, kept)


def _rows(colmap: Any, descriptors: Any, kept: Any) -> Any:
    return colmap.FeatureDescriptors(
        type=descriptors.type, data=np.ascontiguousarray(descriptors.data[kept])
    )


def _shrunk(image: U8) -> tuple[U8, float]:
    """The image, made smaller if it is large, and by how much."""
    scale = min(1.0, _MAX_SIDE_PX / max(image.shape))
    if scale == 1.0:
        return np.ascontiguousarray(image), 1.0
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    smaller: U8 = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return smaller, size[0] / image.shape[1]


def _match(colmap: Any, job: Job, folder: Path, with_features: list[bool], say: Say) -> None:
    """Match the pairs and keep what a geometry of two views explains."""
    pairs = [(i, j) for i, j in job.pairs if with_features[i] and with_features[j]]
    options = colmap.FeatureMatchingOptions()
    options.num_threads = job.threads
    options.use_gpu = False
    pairing = colmap.ImportedPairingOptions()
    # A list at a time, for the progress bar.
    step = max(50, len(pairs) // 50)
    for begin in range(0, len(pairs), step):
        part = pairs[begin : begin + step]
        text = "".join(f"{name_of(i)} {name_of(j)}\n" for i, j in part)
        pairing.match_list_path = folder / "pairs.txt"
        (folder / "pairs.txt").write_text(text)
        colmap.match_image_pairs(folder / job_file.DATABASE, options, pairing)
        say("matches", begin + len(part), len(pairs))


def _reconstruct(colmap: Any, job: Job, folder: Path, say: Say) -> None:
    options = colmap.IncrementalPipelineOptions()
    # COLMAP's sums depend on the number of threads.
    options.num_threads = 1
    options.random_seed = _SEED
    options.extract_colors = False
    options.min_model_size = _MIN_MODEL
    options.ba_refine_focal_length = False
    options.ba_refine_principal_point = False
    options.ba_refine_extra_params = job.refine_lens
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    placed = 2  # the first pair is placed without a word

    def one_more() -> None:
        nonlocal placed
        placed = min(placed + 1, len(job.photos))
        say("poses", placed, len(job.photos))

    (folder / job_file.MODELS).mkdir()
    models = colmap.incremental_mapping(
        folder / job_file.DATABASE,
        folder,
        folder / job_file.MODELS,
        options,
        next_image_callback=one_more,
    )
    for number, model in models.items():
        if job.refine_lens and model.num_reg_images() == max(
            other.num_reg_images() for other in models.values()
        ):
            confirm_lenses(colmap, job, folder / job_file.MODELS / str(number))


def _end_with_parent() -> None:
    """Have the kernel end this process when the build that started it is killed."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _say(stage: str, done: int, total: int) -> None:
    sys.stdout.write(f"{stage} {done} {total}\n")
    sys.stdout.flush()


def main() -> int:
    """Run the job in the folder of the command line."""
    if sys.platform == "linux":
        _end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the group; the parent decides
    cv2.setNumThreads(1)
    try:
        run(Path(sys.argv[1]), _say)
    except EdgeError as error:
        sys.stdout.write(f"error {error}\n")
        return 2
    except OSError as error:
        sys.stdout.write(f"error {sys.argv[1]}: cannot be written ({error.strerror}); make room\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
