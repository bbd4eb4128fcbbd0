"""The covariance of a pose: `covariance` combines its parts, `dispersion` is the jackknife over the references."""
