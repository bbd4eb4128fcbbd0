"""Bundle adjustment: the pose, the points, the references and the intrinsics together, and the covariance.

Begin with `adjust`, which also estimates intrinsics. `normal_equations` are the equations of a step, `bundle` the
problem, `pose_problem` that of one pose, `dispersion` the covariance, `intrinsics` their errors, `priors` what is known
of the pose beforehand, `estimate` the result and its radii.
"""
