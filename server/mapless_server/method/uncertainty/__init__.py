"""How far a pose may be off: `covariance` has the model, `dispersion` its data, `perturbation` the conventions."""
