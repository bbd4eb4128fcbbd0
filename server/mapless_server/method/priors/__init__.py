"""Priors on a pose (`known`), and pose estimation with them (`informed`)."""
