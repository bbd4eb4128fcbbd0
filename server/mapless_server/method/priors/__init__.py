"""Priors on a pose (`known`), and pose estimation with them: `gravity`, `informed`, `pose_only`."""
