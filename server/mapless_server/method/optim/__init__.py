"""Least squares: one Levenberg-Marquardt with robust losses, small motions of poses, options that check themselves."""
