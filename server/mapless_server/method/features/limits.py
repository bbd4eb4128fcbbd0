"""Limits that hold wherever keypoints are found, matched and explained; pixels are those of the processed image."""

MULTIPLE_PX = 32
"""Sides of the images that networks take are multiples of it, so none is shorter."""

MAX_SIDE_PX = 1024
"""Longer images are reduced to this side before features are found; networks were trained and published with it."""

MAX_KEYPOINTS = 2048
"""The strongest keypoints of an image that are kept; matching is quadratic in it."""

LOSS_SCALE_PX = 1.0
"""Scale of robust losses of reprojection errors; about the error of a good keypoint."""

EPIPOLAR_PX = 2.0
"""Largest distance of a right match from its epipolar line."""

INLIER_PX = 4.0
"""Largest reprojection error of a right match."""

INEXACT_INLIER_PX = 12.0
"""Largest reprojection error of a right match at a pose, or of a point, that is not exact yet."""

MIN_INLIERS = 4
"""Fewer inliers give no pose: any three agree with one."""
