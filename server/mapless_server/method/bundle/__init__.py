"""Bundle adjustment: the pose, the points, the references and the intrinsics together, and the covariance.

Begin with `adjust`. `unknowns` and `normal_equations` are the equations of a step, `bundle` the problem, `pose_problem`
that of one pose, `recalibrate` the estimation of intrinsics, `dispersion` and `radii` the covariance and the radii,
`priors` what is known of the pose beforehand, `estimate` the result.
"""
