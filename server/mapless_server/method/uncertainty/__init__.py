"""The covariance of a pose (`covariance`), from its changes without parts of the data (`dispersion`); its `radii`."""
