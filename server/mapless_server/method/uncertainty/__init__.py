"""The covariance of a pose: `covariance` combines its parts, `dispersion` is the jackknife; `radii` follow from it."""
