# SPDX-License-Identifier: MIT
"""Places of one surface in another: found without a first guess, by Open3D.

Fast point feature histograms (Rusu, Blodow and Beetz 2009) tell which points look alike, RANSAC which of
those pairs agree; point-to-plane ICP (Chen and Medioni 1991) brings the surfaces onto each other.
"""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from tsfusion.core.errors import MissingDependency
from tsfusion.evaluation.surface_fit import SampledSurface
from tsfusion.geometry import se3
from tsfusion.geometry.se3 import Transform

_INSTALL = (
    "maps are aligned with Open3D and scipy: pip install '.[align]' in your clone of tsfusion, with a Python "
    "up to 3.12"
)
_SEEDS = 4  # runs of RANSAC
_FEATURE_RADIUS = 5.0  # cells
_FEATURE_POINTS = 100
_REACH = 1.5  # cells between points that belong together
_EDGE_LENGTHS = 0.9  # least ratio of two sides of a triangle that belong together
_ITERATIONS, _CONFIDENCE = 100_000, 0.999
_ICP_ITERATIONS = 60
_LOSS = 0.7  # of the reach: distances beyond it do not pull
_ICP_REACH = (3.0, 1.5, 0.6)  # cells, one after the other


def open3d() -> Any:
    """The library.

    Raises:
        MissingDependency: without it.
    """
    try:
        import open3d
    except ImportError as error:
        raise MissingDependency(_INSTALL) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)  # it warns of every bad guess
    return open3d


def check_installed() -> None:
    """Raise MissingDependency where Open3D or scipy is not installed, without loading them."""
    for name in ("open3d", "scipy"):
        if find_spec(name) is None:
            raise MissingDependency(_INSTALL)


class SurfaceRegistration:
    """Two surfaces, of which the second is brought onto the first: two cells, points and features each."""

    def __init__(self, a: SampledSurface, b: SampledSurface) -> None:
        self._o3d = open3d()
        self._registration = self._o3d.pipelines.registration
        self._a, self._b = self._cloud(a), self._cloud(b)
        self._cell = a.cell

    def candidates(self) -> list[Transform]:
        """Likely `T_a_b`, (4, 4) each, as RANSAC finds them from several seeds; not refined."""
        found, registration = [], self._registration
        features = [self._features(cloud) for cloud in (self._b, self._a)]
        reach = _REACH * self._cell
        checks = [
            registration.CorrespondenceCheckerBasedOnEdgeLength(_EDGE_LENGTHS),
            registration.CorrespondenceCheckerBasedOnDistance(reach),
        ]
        for seed in range(_SEEDS):
            self._o3d.utility.random.seed(seed)
            result = registration.registration_ransac_based_on_feature_matching(
                self._b, self._a, *features, True, reach,
                registration.TransformationEstimationPointToPoint(False), 3, checks,
                registration.RANSACConvergenceCriteria(_ITERATIONS, _CONFIDENCE),
            )  # fmt: skip
            if result.fitness > 0:
                found.append(se3.nearest(np.array(result.transformation)))
        return found

    def refined(self, T_a_b: Transform, reaches: Sequence[float] = _ICP_REACH) -> Transform:
        """The transform after point-to-plane ICP, with a shorter reach each time, in cells."""
        T = T_a_b
        registration = self._registration
        enough = registration.ICPConvergenceCriteria(1e-7, 1e-7, _ICP_ITERATIONS)
        for reach in reaches:
            loss = registration.TukeyLoss(_LOSS * reach * self._cell)
            method = registration.TransformationEstimationPointToPlane(loss)
            result = registration.registration_icp(self._b, self._a, reach * self._cell, T, method, enough)
            T = np.array(result.transformation)
        return se3.nearest(T)

    def _cloud(self, surface: SampledSurface) -> Any:
        vectors = self._o3d.utility.Vector3dVector
        cloud = self._o3d.geometry.PointCloud(vectors(surface.points))
        cloud.normals = vectors(surface.normals)
        return cloud

    def _features(self, cloud: Any) -> Any:
        around = self._o3d.geometry.KDTreeSearchParamHybrid(
            radius=_FEATURE_RADIUS * self._cell, max_nn=_FEATURE_POINTS
        )
        return self._registration.compute_fpfh_feature(cloud, around)
