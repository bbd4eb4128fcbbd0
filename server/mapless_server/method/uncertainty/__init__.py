"""The covariance of a pose, from its changes without parts of the data (`dispersion`); its `radii`."""
