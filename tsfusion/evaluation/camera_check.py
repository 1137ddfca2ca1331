# SPDX-License-Identifier: MIT
"""Check the camera: with correct poses, do frames fit each other better with other intrinsics?

The points of a frame depend on the intrinsics, and so do their projections into another frame. With correct
poses, frames fit best with the true focal length: it is found by a search. For a stereo camera a wrong focal
length looks like another scale of the poses. A principal point far from the image's centre has usual causes,
which are tried: images of another size, exchanged numbers, a transposed matrix.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tsfusion.evaluation.fitted_factors import AS_GOOD, MIN_FOCAL_SIGMA, FittedFactor, sure_gain, zoomed
from tsfusion.evaluation.frame_pairs import Fits, FramePair, best_fits_near, fits_of, share_of_best
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform

MAX_OFF_CENTRE = 0.1  # of the image's side; a principal point farther from the centre is doubtful
CROPPED = 0.15  # a cropped, undistorted image, as an Azure Kinect's, has it up to here
MIN_RESIZED = 1.15  # two sizes of an image with a smaller ratio count as the same
SAME_FACTOR = 0.1  # smaller relative difference between the factors of width and height = none
USUAL_SIZES = (0.25, 1 / 3, 0.5, 2 / 3, 1.5, 2.0, 3.0, 4.0)
UNEQUAL_FOCAL = 0.03  # with a larger relative difference, fx and fy may have been exchanged
MAX_FOCAL_SIGMA = 0.1  # of the focal length; with more, the focal length is not known
MIN_SHARE_OF_BEST = 0.8  # fit divided by the best fit near it, with the found camera
OUTSIDE = 0.45  # of the image's side; a principal point farther from the centre is of another image
_ALONG_RAY = (
    "depth is measured along each pixel's ray instead of z, along the optical axis: give --option "
    "depth_along_ray=true"
)
GIVE = "check the intrinsics, or give --intrinsics fx,fy,cx,cy or --calibration FILE"


@dataclass(frozen=True)
class CameraMistake:
    """Intrinsics that may be meant instead of the given ones.

    Attributes:
        name: short, for programs.
        camera: the intrinsics meant.
        text: the mistake and its remedy.
        along_ray: True if depth was measured along each pixel's ray, not along the optical axis.
    """

    name: str
    camera: Intrinsics
    text: str
    along_ray: bool = False


def centre_doubt(K: Intrinsics | None, shape: tuple[int, ...]) -> str | None:
    """Return a sentence with the likely reason if the principal point is far from the centre, or None."""
    if K is None or _offset(K, shape) <= MAX_OFF_CENTRE:
        return None
    likely = likely_cameras(K, shape)[0]
    if likely.name == "principal point" and _offset(K, shape) <= CROPPED:
        return None
    place = "outside" if is_outside(K, shape) else "far from the centre of"
    found = f"the principal point ({K.cx:.5g}, {K.cy:.5g}) lies {place} the {_size(shape)} images: "
    return found + likely.text


def is_outside(K: Intrinsics, shape: tuple[int, ...]) -> bool:
    """Return True if the principal point is at the image's border or outside, as with no real camera."""
    return _offset(K, shape) > OUTSIDE


def centre_fits(pairs: Sequence[FramePair], motions: Sequence[Transform], given: Fits) -> bool:
    """Return True if frames fit worse with all likely cameras: this confirms the given principal point."""
    view = pairs[0].first_view
    if view.camera is None:
        return True
    likely = [_fits_with(each, pairs, motions) for each in likely_cameras(view.camera, view.shape)]
    return all(fits.mean() < given.mean() - AS_GOOD for fits in likely)


def likely_cameras(K: Intrinsics, shape: tuple[int, ...]) -> list[CameraMistake]:
    """Return intrinsics that may be meant, if the principal point is far from the centre, or fx is not fy."""
    found: list[CameraMistake | None] = []
    if _offset(K, shape) > MAX_OFF_CENTRE:
        found += [_of_other_size(K, shape), _exchanged_centre(K, shape), _centred(K, shape)]
    if abs(abs(K.fy) / K.fx - 1) > UNEQUAL_FOCAL:
        exchanged = Intrinsics(abs(K.fy), float(np.copysign(K.fx, K.fy)), K.cx, K.cy)
        text = f"fx and fy are exchanged: give {_flag(exchanged)}"
        found.append(CameraMistake("exchanged focal lengths", exchanged, text))
        for focal in (K.fx, abs(K.fy)):
            square = Intrinsics(focal, float(np.copysign(focal, K.fy)), K.cx, K.cy)
            text = f"fx and fy differ, but frames fit best with {focal:.5g} for both: give {_flag(square)}"
            found.append(CameraMistake("unequal focal lengths", square, text))
    return [mistake for mistake in found if mistake is not None]


def _of_other_size(K: Intrinsics, shape: tuple[int, ...]) -> CameraMistake | None:
    """Return intrinsics scaled from another image size, by the factor that centres the principal point."""
    if K.cx <= 0 or K.cy <= 0:
        return None
    factors = shape[1] / (2 * K.cx + 1), shape[0] / (2 * K.cy + 1)
    factor = float(np.sqrt(factors[0] * factors[1]))
    if abs(factors[0] / factors[1] - 1) > SAME_FACTOR or max(factor, 1 / factor) < MIN_RESIZED:
        return None
    nearest = min(USUAL_SIZES, key=lambda usual: abs(np.log(usual / factor)))
    factor = nearest if abs(nearest / factor - 1) < SAME_FACTOR else factor
    old, meant = _size(tuple(round(side / factor) for side in shape)), K.scaled(factor)
    text = (
        f"the intrinsics are of {old} images, these are {_size(shape)}: multiply fx, fy, cx and cy by "
        f"{factor:.4g}, or give {_flag(meant)}"
    )
    return CameraMistake("image size", meant, text)


def _exchanged_centre(K: Intrinsics, shape: tuple[int, ...]) -> CameraMistake | None:
    meant = Intrinsics(K.fx, K.fy, K.cy, K.cx)
    if _offset(meant, shape) > min(MAX_OFF_CENTRE, _offset(K, shape) / 2):
        return None
    text = f"cx and cy are exchanged, or of the image turned by 90°: give {_flag(meant)}"
    return CameraMistake("exchanged centre", meant, text)


def _centred(K: Intrinsics, shape: tuple[int, ...]) -> CameraMistake:
    meant = Intrinsics(K.fx, K.fy, (shape[1] - 1) / 2, (shape[0] - 1) / 2)
    why = "cx and cy seem wrong: cameras have them near the centre of the image"
    if K.cx == 0 and K.cy == 0:
        why = "cx and cy are 0, as they are read from a camera matrix that is transposed (columns for rows)"
    text = f"{why}; give {_flag(meant)}, or better the measured ones"
    return CameraMistake("principal point", meant, text)


def best_camera(
    pairs: Sequence[FramePair], motions: Sequence[Transform], given: Fits, focal: FittedFactor | None
) -> tuple[float, CameraMistake | None, Fits]:
    """Return gain in fit, mistake and fits of the likely camera that surely fits best; gain 0 = none does.

    Args:
        focal: factor on the focal length that fits best; None if it was not searched.
    """
    view = pairs[0].first_view
    K = view.camera
    nothing: tuple[float, CameraMistake | None, Fits] = (0.0, None, given)
    if K is None:
        return nothing
    tried = [nothing]
    likely = likely_cameras(K, view.shape)
    likely += [] if view.stereo else [CameraMistake("depth along rays", K, _ALONG_RAY, along_ray=True)]
    for mistake in likely:
        fits = _fits_with(mistake, pairs, motions)
        tried.append((sure_gain(fits, given), mistake, fits))
    if focal is not None and focal.sigma <= MAX_FOCAL_SIGMA:
        tried.append((focal.gain, _focal_mistake(K, focal), focal.fits))
    most = max(gain for gain, _, _ in tried)
    gain, camera, fits = next(
        each for each in tried if each[0] == most or each[0] > max(0, most - AS_GOOD / 2)
    )
    if camera is None:
        return nothing
    seen = [pair.seen_by(camera.camera, along_ray=camera.along_ray) for pair in pairs]
    explained = share_of_best(fits, best_fits_near(seen, motions)) >= MIN_SHARE_OF_BEST
    return (gain, camera, fits) if explained else nothing


def _fits_with(meant: CameraMistake, pairs: Sequence[FramePair], motions: Sequence[Transform]) -> Fits:
    return fits_of([pair.seen_by(meant.camera, along_ray=meant.along_ray) for pair in pairs], motions)


def _focal_mistake(K: Intrinsics, found: FittedFactor) -> CameraMistake:
    camera = zoomed(K, found.factor)
    sigma = max(found.sigma, MIN_FOCAL_SIGMA) * camera.fx
    wrong = "wide" if found.factor > 1 else "narrow"
    text = (
        f"frames fit best with a focal length of about {camera.fx:.0f} ± {sigma:.0f} px, the camera used "
        f"says {K.fx:.4g}: everything comes out {abs(found.factor - 1):.0%} too {wrong}; {GIVE}"
    )
    return CameraMistake("focal length", camera, text)


def _offset(K: Intrinsics, shape: tuple[int, ...]) -> float:
    """Return the distance of the principal point from the centre, as a share of the image's side."""
    return max(abs((K.cx + 0.5) / shape[1] - 0.5), abs((K.cy + 0.5) / shape[0] - 0.5))


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}×{shape[0]}"


def _flag(K: Intrinsics) -> str:
    return f"--intrinsics {K.fx:.5g},{K.fy:.5g},{K.cx:.5g},{K.cy:.5g}"
