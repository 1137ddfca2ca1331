# SPDX-License-Identifier: MIT
"""Check whether poses, camera and depth agree: project frames into their neighbours, and measure the fit.

If frames do not fit, corrections of the usual mistakes are tried: of poses (inverted, OpenGL axes, wrong
units, …) and of the camera (`camera_check`). A correction that fits clearly better is named. Otherwise, small
corrections of the poses show whether the measurements could fit better, and `trajectory_check` looks for a
jump and for drift. If the sensor hardly moves, or the frames share no surface, the verdict is `cannot tell`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.color_placement import misplaced_color, outlines
from tsfusion.datasets.dataset import Dataset, frame_of, readable
from tsfusion.evaluation.camera_check import (
    MAX_FOCAL_SIGMA,
    CameraMistake,
    best_camera,
    centre_doubt,
    centre_fits,
    is_outside,
    likely_cameras,
)
from tsfusion.evaluation.depth_views import (
    doubtful_depth,
    unit_evidence,
    unusable_depth,
)
from tsfusion.evaluation.fitted_factors import (
    AS_GOOD,
    MIN_FOCAL_SIGMA,
    FittedFactor,
    fitted_focal_length,
    fitted_scale,
    time_shift,
    time_text,
)
from tsfusion.evaluation.frame_pairs import (
    MIN_FIT,
    Fits,
    FramePair,
    SeenFrame,
    best_fits_near,
    fits_of,
    mean_gain,
    mean_where,
    pairs_of,
    scaled_motion,
    seen_frames,
    share_of_best,
    wanted_pairs,
)
from tsfusion.evaluation.pose_mistakes import (
    IN_WORLD,
    MISTAKES,
    SCALES,
    Content,
    Mistake,
    alternatives_text,
    not_ruled_out_text,
    scale_text,
)
from tsfusion.evaluation.trajectory_check import find_fault
from tsfusion.geometry.se3 import Transform

PoseVerdict = Literal["agree", "disagree", "cannot tell"]

MIN_LEAD = 0.05  # by which the poses must fit better than the median mistake, or it is `cannot tell`
MIN_EVIDENCE = 0.2  # share of the pairs that must fit, or it is `cannot tell`
MIN_UNEXPLAINED_PAIRS = 2  # pairs that fit after small corrections
MIN_MISFIT_PAIRS, MAX_MISFIT = 3, 0.3  # pairs that see one scene, and a fit that none of them reaches
FOLLOWING = 0.2  # share of the poses' motion by which points move that are in the world
ONE_MEASUREMENT = 1 - 1e-6  # fit without any motion; noise leaves less
MIN_SHARE_OF_BEST = 0.8  # fit divided by the best fit near it: less is a disagreement
TIME_SHIFT_BELOW = 0.97  # share of the best fit; with less, shifted times are tried
AS_LIKELY = 0.8  # of the best explanation's gain; with more, another explanation is named too
_DISAGREE, _CAMERA = "poses and depth disagree", "camera and depth disagree"
_PUT_RIGHT = (
    "points and their times disagree: scans fit better where the sensor's motion is left in, as it was taken "
    "out before; --option deskew=false leaves the points as they are"
)
_UNEXPLAINED = (
    f"{_DISAGREE}, and none of the usual mistakes explains it: small corrections make frames fit "
    "much better than the poses do; the poses may be wrong, of another sensor or body, or badly timed"
)


@dataclass(frozen=True)
class PoseCheckReport:
    """Result of `check`: the verdict on poses and camera, and the evidence for it."""

    verdict: PoseVerdict  # `disagree` only when it is sure
    text: str  # one or two sentences: the mistake and its remedy
    # The mistake: a name in `MISTAKES`, `scale`, `time`, `point times`, `depth unit`, of the camera
    # (`focal length`, `image size`, `exchanged centre`, `principal point`, `exchanged focal lengths`,
    # `unequal focal lengths`, `depth along rays`), `jump`, `drift` or `repeated frames` (in a part), or
    # `unexplained`; None if poses and depth agree
    mistake: str | None = None
    alternatives: tuple[str, ...] = ()  # other mistakes whose correction fits as well
    fitting_camera: tuple[float, float, float, float] | None = None  # fx fy cx cy, if wrong
    # Focal length used, the best-fitting one and its standard error, pixels; None if not known
    focal_px: tuple[float, float, float] | None = None
    color: str | None = None  # a sentence if colour is misplaced; None if not, or not known
    factor: float | None = None  # for `scale`, factor for the translations
    shift: float | None = None  # for `time`, each frame fits the pose so many frames later
    frames: tuple[int, int] | None = (
        None  # for `jump`, `drift` and `repeated frames`, indices of the two frames
    )
    metres: float | None = None  # for `jump` and `drift`, size of the error
    pairs: int = 0  # number of pairs of frames compared
    fit: float | None = None  # 0 to 1, fit of the pairs as given; 1 = far within the sensors' tolerance
    best_fit: float | None = None  # the fit after small corrections
    # The fit after the correction of each mistake, by its name
    tried: dict[str, float] = field(default_factory=dict)


def check(dataset: Dataset) -> PoseCheckReport:
    """Compare neighbouring frames of a dataset, as given and corrected for usual mistakes; then distant ones.

    It takes one or two seconds, for a LiDAR some more, and reads 20 to 50 frames.

    Raises:
        DatasetError: a frame cannot be read.
    """
    wanted = wanted_pairs(len(dataset))
    frames = seen_frames(dataset, wanted)
    pairs = pairs_of(frames, wanted)
    report = _of_depth(frames) or _of_fits(dataset, frames, pairs)
    doubt = doubtful_depth([frame.depth for frame in frames.values()], getattr(dataset, "depth_unit", None))
    if report.verdict == "cannot tell" and doubt is not None:
        return replace(report, verdict="disagree", text=doubt, mistake="depth unit")
    if report.verdict != "disagree":
        report = _with_doubt(report, frames, pairs)
    if report.mistake in (None, "unexplained"):
        report = _of_repeats(pairs) or _with_fault(report, dataset, dict(frames))
    color = misplaced_color({index: frame.outlines for index, frame in frames.items()})
    if color is None:
        return report
    return replace(
        report, color=color, text=f"{report.text}; {'but' if report.verdict == 'agree' else 'also'} {color}"
    )


def check_frames(dataset: Dataset) -> tuple[str | None, str | None]:
    """Return mistakes that do not depend on poses: a sentence on depth and one on colour, or None for each.

    It reads the same frames as `check`, and keeps only the edges of each.

    Raises:
        DatasetError: a frame cannot be read.
    """
    units, edges = [], {}
    indices = sorted({index for pair in wanted_pairs(len(dataset)) for index in pair} or {0})
    for index, frame in readable(partial(frame_of, dataset), indices):
        if frame.kind == "points":
            return None, None
        units.append(unit_evidence(frame, None))
        edges[index] = outlines(frame)
    doubt = doubtful_depth(units, getattr(dataset, "depth_unit", None))
    return unusable_depth(units) or doubt, misplaced_color(edges)


def _with_doubt(
    report: PoseCheckReport, frames: Mapping[int, SeenFrame], pairs: list[FramePair]
) -> PoseCheckReport:
    """Add a doubt about the camera to the report, unless the frames confirm the camera."""
    view = next((frame.view for frame in frames.values() if frame.view is not None), None)
    doubt = None if view is None else centre_doubt(view.camera, view.shape)
    if doubt is None or view is None or view.camera is None:
        return report
    motions = [pair.motion() for pair in pairs]
    if pairs and centre_fits(pairs, motions, fits_of(pairs, motions)):
        return report
    if not is_outside(view.camera, view.shape):
        return replace(report, text=f"{report.text}; but {doubt}")
    likely = likely_cameras(view.camera, view.shape)[0]
    return replace(
        report,
        verdict="disagree",
        text=f"{_CAMERA}: {doubt}",
        mistake=likely.name,
        alternatives=(),
        fitting_camera=msgspec.structs.astuple(likely.camera),
    )


def _of_repeats(pairs: list[FramePair]) -> PoseCheckReport | None:
    """Return a report of two images that are one, and poses by which they share a place and do not fit."""
    for pair in pairs:
        fit = pair.fit_of_shared(pair.motion()) if pair.first_view.camera else None
        if fit is not None and fit < MIN_FIT and pair.fit(np.eye(4)) > ONE_MEASUREMENT:
            text = f"{_DISAGREE}: frames {pair.first} and {pair.second} hold one measurement at two poses"
            return PoseCheckReport("disagree", text, "repeated frames", frames=(pair.first, pair.second))
    return None


def _with_fault(report: PoseCheckReport, dataset: Dataset, frames: dict[int, SeenFrame]) -> PoseCheckReport:
    """Add to the report the two frames between which the trajectory is surely wrong, if there are any."""

    def compare(first: int, second: int) -> FramePair | None:
        unread = [index for index in (first, second) if index not in frames]
        frames.update(seen_frames(dataset, [tuple(unread)]) if unread else {})
        return next(iter(pairs_of(frames, [(first, second)])), None)

    ranges = [frame.view.range_m for frame in frames.values() if frame.view is not None]
    fault = find_fault(dataset, compare, float(np.median(ranges))) if ranges else None
    if fault is None or (report.mistake is not None and fault.mistake != "jump"):
        return report
    return replace(
        report, verdict="disagree", text=f"{_DISAGREE}: {fault.text}", mistake=fault.mistake,
        alternatives=(), frames=fault.frames, metres=fault.metres,
    )  # fmt: skip


def _of_depth(frames: Mapping[int, SeenFrame]) -> PoseCheckReport | None:
    """Return a report if depth alone shows that something is wrong, such as its unit, else None."""
    if (wrong := unusable_depth([frame.depth for frame in frames.values()])) is not None:
        return PoseCheckReport("disagree", wrong, "depth unit")
    if all(frame.view is None for frame in frames.values()):
        return PoseCheckReport(
            "cannot tell",
            f"none of the {len(frames)} frames looked at has a surface: depth is empty or only noise",
        )
    return None


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Pairs of frames, with their fits (0 to 1) as given and after small corrections of the poses."""

    dataset: Dataset
    content: Content
    pairs: list[FramePair]
    motions: list[Transform]
    given: Fits
    best: Fits
    focal: FittedFactor | None

    @property
    def known(self) -> NDArray[np.bool_]:
        return self.best >= MIN_FIT


def _of_fits(dataset: Dataset, frames: Mapping[int, SeenFrame], pairs: list[FramePair]) -> PoseCheckReport:
    if not pairs:
        posed = sum(frame.T_world_camera is not None for frame in frames.values())
        text = f"no two frames with a pose and a measurement ({posed} of {len(frames)} looked at have a pose)"
        return PoseCheckReport("cannot tell", text)
    motions = [pair.motion() for pair in pairs]
    given = fits_of(pairs, motions)
    skewed = [
        replace(pair, first_view=first, second_view=second)
        for pair in pairs
        if (first := frames[pair.first].skewed) and (second := frames[pair.second].skewed)
    ]
    if len(skewed) == len(pairs) and mean_gain(fits_of(skewed, motions), given) > 0:
        return PoseCheckReport("disagree", _PUT_RIGHT, "point times", pairs=len(pairs))
    seen = _Comparison(
        dataset,
        _content(dataset, next(frame for frame in frames.values() if frame.view is not None)),
        pairs,
        motions,
        given,
        best_fits_near(pairs, motions),
        fitted_focal_length(pairs, motions, given),
    )
    mistakes = _mistakes(seen)
    corrected = {mistake.name: [pair.motion(mistake.intended) for pair in pairs] for mistake in mistakes}
    tried = {name: fits_of(pairs, moved) for name, moved in corrected.items()}
    report = _disagreement(seen, tried, corrected) or _agreement(seen, tried)
    return replace(
        report,
        pairs=len(pairs),
        fit=mean_where(seen.given, seen.known),
        best_fit=mean_where(seen.best, seen.known),
        focal_px=_focal_px(seen),
        tried={
            name: mean_where(fits, np.maximum(fits, seen.given) >= MIN_FIT)
            for name, fits in tried.items()
            if seen.content.holds(name) or name == report.mistake
        },
    )


def _focal_px(seen: _Comparison) -> tuple[float, float, float] | None:
    camera = seen.pairs[0].first_view.camera
    if camera is None or seen.focal is None or seen.focal.sigma > MAX_FOCAL_SIGMA:
        return None
    fitted = camera.fx * seen.focal.factor
    return round(camera.fx, 1), round(fitted, 1), round(fitted * max(seen.focal.sigma, MIN_FOCAL_SIGMA), 1)


def _content(dataset: Dataset, frame: SeenFrame) -> Content:
    return Content(
        "points" if frame.kind == "points" else "depth" if frame.kind == "depth" else "disparity",
        integer_depth=frame.depth.integer,
        quaternions=getattr(dataset, "quaternions", False),
        kitti=dataset.name.startswith("KITTI"),
    )


def _mistakes(seen: _Comparison) -> tuple[Mistake, ...]:
    return MISTAKES + (IN_WORLD,) * (seen.content.measures == "points" and _follow_poses(seen.pairs))


def _follow_poses(pairs: list[FramePair]) -> bool:
    """Return True if points move as the poses do. In a tunnel they stay, in a hall they move against them."""
    middles = [[np.median(view.points, 1) for view in (pair.first_view, pair.second_view)] for pair in pairs]
    moved = np.array([second[:3, 3] - first[:3, 3] for first, second in (pair.poses for pair in pairs)])
    return bool((np.diff(middles, axis=1)[:, 0] * moved).sum() > FOLLOWING * (moved**2).sum())


def _disagreement(
    seen: _Comparison, tried: Mapping[str, Fits], corrected: Mapping[str, list[Transform]]
) -> PoseCheckReport | None:
    """Return the report of the mistake whose correction surely fits better, or None if none does."""
    pairs, given, report = seen.pairs, seen.given, partial(PoseCheckReport, "disagree")
    gains = {name: mean_gain(fits, given) for name, fits in tried.items()}
    gain = max(gains.values())
    scale = fitted_scale(pairs, seen.motions, given, usual=[factor for factor, _ in SCALES])
    camera_gain, camera, fits = best_camera(pairs, seen.motions, given, seen.focal)
    if camera is not None and camera_gain > max(gain, scale.gain):
        return _camera_report(seen, camera, fits, scale)
    likely = [mistake for mistake in _mistakes(seen) if gains[mistake.name] > gain - AS_GOOD]
    likely = [mistake for mistake in likely if seen.content.holds(mistake.name)] or likely
    if gain > 0 and gain >= scale.gain and _cannot_improve(pairs, corrected[likely[0].name]):
        others = tuple(mistake.name for mistake in likely[1:])
        text = f"{_DISAGREE}: {likely[0].text_for(seen.content)}{alternatives_text(others)}"
        return report(text, likely[0].name, others)
    if scale.gain > 0 and _cannot_improve(
        pairs, [scaled_motion(motion, scale.factor) for motion in seen.motions]
    ):
        either = camera is not None and _as_likely(fits, scale.fits, given)
        return report(
            f"{_DISAGREE}: {scale_text(scale.factor, seen.content)}"
            + (f"; or it is the camera: {camera.text}" if camera is not None and either else ""),
            "scale",
            (camera.name,) if camera is not None and either else (),
            factor=round(scale.factor, 4),
        )
    share = share_of_best(given, seen.best)
    if share < TIME_SHIFT_BELOW and (late := time_shift(seen.dataset, pairs, seen.best)) is not None:
        return report(f"{_DISAGREE}: {time_text(seen.dataset, late)}", "time", shift=late)
    if share < MIN_SHARE_OF_BEST and seen.known.sum() >= min(MIN_UNEXPLAINED_PAIRS, len(pairs)):
        return report(_UNEXPLAINED, "unexplained")
    return None


def _camera_report(
    seen: _Comparison, camera: CameraMistake, fits: Fits, scale: FittedFactor
) -> PoseCheckReport:
    """Return the report of a wrong camera; and of the scale too, if it explains the misfit about as well."""
    either = _as_likely(scale.fits, fits, seen.given)
    text = f"{_CAMERA}: {camera.text}"
    return PoseCheckReport(
        "disagree",
        text + (f"; or it is the scale: {scale_text(scale.factor, seen.content)}" if either else ""),
        camera.name,
        ("scale",) if either else (),
        factor=round(scale.factor, 4) if either else None,
        fitting_camera=None if camera.along_ray else msgspec.structs.astuple(camera.camera),
    )


def _as_likely(other: Fits, best: Fits, given: Fits) -> bool:
    """Return True if other fits explain the misfit about as well as the best fits do."""
    evidence = np.maximum(other, best) >= MIN_FIT
    return bool((other - given)[evidence].mean() > AS_LIKELY * (best - given)[evidence].mean())


def _cannot_improve(pairs: Sequence[FramePair], motions: Sequence[Transform]) -> bool:
    """Return True if small corrections hardly improve the fit of the motions."""
    return share_of_best(fits_of(pairs, motions), best_fits_near(pairs, motions)) >= MIN_SHARE_OF_BEST


def _agreement(seen: _Comparison, tried: Mapping[str, Fits]) -> PoseCheckReport:
    given, report = seen.given, partial(PoseCheckReport, "cannot tell")
    fitting = int((given >= MIN_FIT).sum())
    if fitting < MIN_EVIDENCE * len(given):
        shared = [each.fit_of_shared(motion) for each, motion in zip(seen.pairs, seen.motions, strict=True)]
        fits = [fit for fit in shared if fit is not None]
        is_image = seen.pairs[0].first_view.camera is not None  # sparse scans may miss each other
        if is_image and len(fits) >= MIN_MISFIT_PAIRS and max(fits) < MAX_MISFIT:
            text = f"{_DISAGREE}: all {len(fits)} pairs of frames that see one place fit nowhere there"
            return PoseCheckReport("disagree", f"{text} ({np.mean(fits):.2f} of 1)", "unexplained")
        return report(
            f"nobody can tell: {len(given) - fitting} of {len(given)} pairs of frames fit neither as given "
            "nor after any usual correction: they share too little, or poses, camera and depth are not of "
            "one recording"
        )
    if np.mean(given) - np.median([np.mean(fits) for fits in tried.values()]) < MIN_LEAD:
        return report("nobody can tell: the sensor hardly moves between the frames looked at")
    gains = {
        name: mean_where(fits - given, np.maximum(fits, given) >= MIN_FIT)
        for name, fits in tried.items()
        if seen.content.holds(name)
    }
    equally_good = tuple(name for name, gain in gains.items() if gain > -AS_GOOD)
    text = "poses and depth agree" + not_ruled_out_text(equally_good)
    return PoseCheckReport("agree", text, alternatives=equally_good)
