"""The covariance of a pose (`covariance`), by what changes without parts of the data (`dispersion`); its `radii`."""
