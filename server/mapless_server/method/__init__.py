"""The method: from photographs with features to a pose, or to the reason for a rejection. No service, store or queue.

Begin with `localize`, the stages in order. A module imports only modules above it in this list, which has no circle:

choices                      names of backends and features, for settings
options                      how options check themselves; cancelling and timing of a computation
perturbation                 small motions of poses, coordinates of their errors
optimize                     robust losses; Levenberg-Marquardt, the only one; many small matrices
views                        photographs with features and poses; the result of the coarse stage
rejection                    "no pose" is a result
features/                    local features of a photograph
cache                        results that are kept within a bound, here and by the server
observations                 observations of the same point; metric points
nearest                      nearest neighbours of two photographs' descriptors
epipolar                     the epipolar lines of two photographs with poses, and how far matches are from them
agreement                    (ours) whether two references agree with their poses, by matches that these took no part in
matching, lightglue          how two photographs are matched: nearest neighbours, or a network
stationary                   (ours) what is fixed to the camera, such as a bonnet, and no place
pairs                        pairs of references: their order, their matches as they are cached
stationary_filter            (ours) matches without what is fixed to the camera
correspond                   matches among references, and of the query with them
priors/                      what is known of the query's pose beforehand
intrinsics                   errors of the query's intrinsics, and the evidence of them
results                      scale, structure, matches, pose estimate and its support: data between stages
scale                        metric scale, initial pose
structure                    metric points of the references
match                        2D-3D matches of the query
kept_depth                   (ours) points from depths that are kept with the references
pnp                          pose and inliers
resection                    pose and focal length from fixed points
unknowns, normal_equations   (ours) poses, points and intrinsics; the equations for their steps
bundle                       (ours) everything adjusted together
uncertainty/                 the covariance of a pose
pose_problem                 (ours) the problem of one pose, and the estimate at its optimum
recalibrate                  (ours) intrinsics that a photograph contradicts are estimated too
adjust                       (ours) the last refinement
two_view/                    (ours) pose from matches with posed references, without points
trust/                       whether a pose is accepted, and its trust
one_reference                (ours) pose from one reference, by a network's depths and metres
answer, hints                the answer of the method; what would help after a rejection
coarse/                      query and references reconstructed together, up to scale
pipeline, alternatives       a query between the stages; poses where the stages have no points
localize                     the stages in order
readings/                    (ours) whether photographs fit their poses; which mistake in the data explains it if not
groups/                      several photographs posed together
"""
