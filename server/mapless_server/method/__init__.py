"""The method: from photographs with features to a pose, or to the reason for a rejection. No service, store or queue.

Begin with `localize`, then `solve` and `ladder`. A room imports only rooms above it in this list, which has no circle:

rejection        "no pose" is a result
significance     how surely something contradicts what is given
optim/           Levenberg-Marquardt, robust losses, small motions of poses
features/        features of photographs, their matches, tracks
pairs/           matches of posed photographs; whether photographs agree with their poses, and why not if not
structure/       metric points of the references, 2D-3D matches of the query
bundle/          bundle adjustment of everything together; covariance; priors
promise          whether a further attempt is worth its time
options          the forms of the method that a request can choose; cancelling and timing of a computation
pose/            pose estimators: from points, lines, depths, several cameras
coarse/          query and references reconstructed together, up to scale; the metric scale
judge/           whether a pose is accepted, and its trust; which of several is answered; the answer and its hints
groups/          several photographs posed together
unknown_camera   the camera of a photograph without intrinsics
pipeline         a query between the stages
solve            one attempt's stages in order
ladder           which attempt follows another
localize         attempts until nothing is in doubt
"""
