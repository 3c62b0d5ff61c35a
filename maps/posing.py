# SPDX-License-Identifier: Apache-2.0
"""Gives every image of a build its pose and its unit: from the recording, or from the images."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from edge.cameras.recording import Recording, open_recording
from edge.errors import ConfigError, RecordingError
from edge.geometry import se3, sim3
from edge.geometry.sim3 import Sim3
from edge.relocalise.bow import shipped_vocabulary
from edge.types import F64, DepthSamples, Mat4
from maps import scale
from maps.describe import Description
from maps.lens import described_through
from maps.scale import Hint, Placed
from maps.settings import BuildSettings
from maps.sfm import stored
from maps.sfm.job import Job, Photo, with_k1
from maps.sfm.pairs import choose_pairs
from maps.sfm.solve import SfmResult, solve
from maps.survey import Survey
from maps.views import Origin, ViewSet, choose_unposed, choose_views
from maps.work_folder import key_of

# Without metres a scene's median depth is this: settings that count in metres suit a room.
_DEPTH_UNITS = 2.0
_METRIC_DEPTHS = ("stereo", "lidar")


class BuildInput(NamedTuple):
    """What a map is built from."""

    sequences: list[Path]
    frames: slice | None = None
    every: int = 1
    exclude: frozenset[int] = frozenset()
    poses: str = "given"  # or sfm: from the images alone
    scale: Hint | None = None
    sfm_file: Path | None = None  # keeps what sfm found, and gives it the next time


def posed_views(
    source: BuildInput, settings: BuildSettings, survey: Survey, threads: int = 1
) -> ViewSet:
    """The views of a build; RecordingError where poses or their unit cannot be had."""
    if source.poses == "sfm":
        chosen = _found(source, settings, survey, threads)
    else:
        chosen = choose_views(source.sequences, source.frames, source.every, source.exclude)
        if source.sfm_file is not None:
            raise ConfigError("--sfm: is for --poses sfm; leave it out")
        if source.scale is not None:
            chosen = _scaled(chosen, source.scale)
    _check_depth(settings, chosen.roots[0], metric=chosen.origin.metric)
    return chosen


def adapted(chosen: ViewSet, descriptions: list[Description]) -> list[Description]:
    """Descriptions, made with the recordings' lenses and depths, in those of the views."""
    factors = chosen.origin.depth_scale
    result = []
    for view, description in zip(chosen.views, descriptions, strict=True):
        given, better = chosen.calibrations[view.camera], chosen.cameras[view.camera]
        if better != given:
            description = described_through(description, given, better)
        if factors and factors[view.sequence] != 1.0:
            description = _rescaled(description, factors[view.sequence])
        result.append(description)
    return result


def _rescaled(description: Description, factor: float) -> Description:
    samples = description.samples
    return description._replace(
        depth=description.depth * factor,
        depth_sigma=description.depth_sigma * factor,
        samples=DepthSamples(
            samples.pixels,
            samples.inverse_depth / np.float32(factor),
            samples.sigma / np.float32(factor),
        ),
    )


def _scaled(chosen: ViewSet, hint: Hint) -> ViewSet:
    """Given poses of an unknown unit in metres."""
    if chosen.origin.metric:
        raise ConfigError(
            f"--scale: the poses of {chosen.roots[0]} are in metres; leave it out, or use "
            "--poses sfm to find others"
        )
    recordings = [open_recording(root) for root in chosen.roots]
    placed = _placed(chosen, recordings)
    if hint.kind == "metres":
        s = 1.0
    elif hint.kind == "distance":
        s = scale.of_distance(hint, placed)
    elif hint.kind == "marker":
        s = scale.of_marker(hint, placed)
    else:
        raise ConfigError(f"--scale {hint.kind}: is for --poses sfm; give another hint")
    factors = tuple(s if recording.depth_in_pose_units else 1.0 for recording in recordings)
    origin = Origin("given", True, hint.kind, factors)
    return _moved(chosen, Sim3(s, np.eye(3), np.zeros(3)))._replace(origin=origin)


def _placed(chosen: ViewSet, recordings: list[Recording]) -> list[Placed]:
    return [
        Placed(view, chosen.cameras[view.camera], recordings[view.sequence])
        for view in chosen.views
    ]


def _moved(chosen: ViewSet, S: Sim3) -> ViewSet:
    """The views after a similarity of their frame."""
    views = [
        view._replace(T_map_cam=sim3.transform_pose(S, view.T_map_cam)) for view in chosen.views
    ]
    return chosen._replace(views=views)


def _found(source: BuildInput, settings: BuildSettings, survey: Survey, threads: int) -> ViewSet:
    """Views posed by structure from motion."""
    unposed = choose_unposed(source.sequences, source.frames, source.every, source.exclude)
    job = Job(
        photos=[Photo(str(unposed.roots[v.sequence]), v.image, v.camera) for v in unposed.views],
        cameras=unposed.cameras,
        pairs=[],
        refine_lens=settings.lens == "refined",
        threads=threads,
    )
    recordings = [open_recording(root) for root in unposed.roots]
    _check_unit(source.scale, settings, unposed, recordings)
    result = None if source.sfm_file is None else stored.load(source.sfm_file, job)
    if result is None:
        result = _solved(job, unposed, settings, survey)
        if source.sfm_file is not None:
            stored.save(source.sfm_file, job, result)
    chosen = _with_poses(unposed, result)
    return _in_a_unit(chosen, result, source.scale, settings, recordings)


def _check_unit(
    hint: Hint | None, settings: BuildSettings, unposed: ViewSet, recordings: list[Recording]
) -> None:
    """Refuse a unit that cannot be had whatever is found: before hours of work, not after."""
    if hint is None:
        _check_depth(settings, unposed.roots[0], metric=False)
    elif hint.kind == "metres":
        raise ConfigError("--scale metres: is for given poses; --poses sfm has no unit")
    elif hint.kind == "distance":
        scale.check_chosen(hint, [v.image for v in unposed.views if v.sequence == 0])
    elif hint.kind == "given":
        scale.check_count(len(_true_poses(unposed, recordings)[1]))
    elif hint.kind == "depth" and not _gives_depth(settings, recordings):
        raise RecordingError(
            f"{unposed.roots[0]}: --scale depth needs depth images and --depth given; use another"
        )


def _check_depth(settings: BuildSettings, root: Path, *, metric: bool) -> None:
    if settings.depth in _METRIC_DEPTHS and not metric:
        raise RecordingError(
            f"{root}: --depth {settings.depth} is in metres, the poses are not; give --scale, or "
            "--depth none"
        )


def _gives_depth(settings: BuildSettings, recordings: list[Recording]) -> bool:
    return settings.depth == "given" and any(recording.has_depth for recording in recordings)


def _solved(job: Job, unposed: ViewSet, settings: BuildSettings, survey: Survey) -> SfmResult:
    """Poses from the images, or from an interrupted build that had them already."""
    key = key_of("sfm", stored.identity(job))
    result = survey.work.load(key, SfmResult)
    if result is None:
        words = [description.words for description in survey.describe(unposed, settings)]
        pairs = choose_pairs(words, shipped_vocabulary().n_words)
        job = Job(
            photos=job.photos,
            cameras=job.cameras,
            pairs=pairs,
            refine_lens=job.refine_lens,
            threads=job.threads,
        )
        result = solve(job)
        survey.work.keep(key, result)
    return result


def _with_poses(unposed: ViewSet, result: SfmResult) -> ViewSet:
    """Views that could be placed, in the frame of the first one's camera."""
    T_first_world = se3.inverse(result.T_world_cam[0])
    views = [
        unposed.views[photo]._replace(T_map_cam=T_first_world @ T)
        for photo, T in zip(result.photo.tolist(), result.T_world_cam, strict=True)
    ]
    cameras = [with_k1(c, float(k)) for c, k in zip(unposed.cameras, result.k1, strict=True)]
    skipped = len(unposed.views) - len(views)
    return unposed._replace(cameras=cameras, views=views, skipped=skipped)


def _in_a_unit(
    chosen: ViewSet,
    result: SfmResult,
    hint: Hint | None,
    settings: BuildSettings,
    recordings: list[Recording],
) -> ViewSet:
    """The views in metres where something tells them, else in a unit of the scene's size."""
    ratio = None
    if _gives_depth(settings, recordings):
        ratio = scale.of_depth(*_depths(chosen, result, recordings))
    if hint is None and ratio is not None:
        hint = Hint("depth")
    if hint is None:
        s = _DEPTH_UNITS / float(np.median(result.depth))
        moved = _moved(chosen, Sim3(s, np.eye(3), np.zeros(3)))
        return moved._replace(origin=Origin("sfm", False, "none"))
    S, metric = _similarity(hint, chosen, recordings, ratio)
    factors = () if ratio is None else (S.s / ratio,) * len(recordings)
    return _moved(chosen, S)._replace(origin=Origin("sfm", metric, hint.kind, factors))


def _similarity(
    hint: Hint, chosen: ViewSet, recordings: list[Recording], ratio: float | None
) -> tuple[Sim3, bool]:
    """What takes the views to the map, and whether that is in metres."""
    if hint.kind == "given":
        return scale.onto_poses(*_true_poses(chosen, recordings)), recordings[0].metric
    placed = _placed(chosen, recordings)
    metric = True
    if hint.kind == "distance":
        s = scale.of_distance(hint, placed)
    elif hint.kind == "marker":
        s = scale.of_marker(hint, placed)
    else:
        assert ratio is not None  # checked before the work
        s = ratio
        metric = all(r.metric or not r.depth_in_pose_units for r in recordings)
    return Sim3(s, np.eye(3), np.zeros(3)), metric


def _true_poses(chosen: ViewSet, recordings: Sequence[Recording]) -> tuple[list[Mat4], list[Mat4]]:
    """Poses of views, and the true ones, where there are some."""
    poses, truths = [], []
    for view in chosen.views:
        truth = recordings[view.sequence].groundtruth
        T = truth.pose_at(view.t_ns) if truth is not None else None
        if T is not None:
            poses.append(view.T_map_cam)
            truths.append(T)
    return poses, truths


def _depths(chosen: ViewSet, result: SfmResult, recordings: list[Recording]) -> tuple[F64, F64]:
    """Depths by the depth images, and by the poses, of what the images show."""
    measured, reckoned = [], []
    for number, view in enumerate(chosen.views):
        depth = recordings[view.sequence].depth(view.image)
        if depth is None:
            continue
        begin, end = result.offsets[number : number + 2]
        u, v = np.round(result.pixels[begin:end]).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < depth.shape[1]) & (v < depth.shape[0])
        measured.append(depth[v[inside], u[inside]].astype(np.float64))
        reckoned.append(result.depth[begin:end][inside].astype(np.float64))
    empty = [np.empty(0)]
    return np.concatenate(measured or empty), np.concatenate(reckoned or empty)
