"""The method: from photographs with features to a pose, or why there is none. It knows no service, store or queue.

Begin with `localize`, the stages in order. A module imports only modules above it in this list, which has no circle:

options                      what a request chooses; how options check themselves
arrays, context              either NumPy or torch; cancels a computation and times its stages
rigid, robust, optimize      small motions; robust losses; Levenberg-Marquardt, the only one
views, reconstruction        photographs with features and poses; what the coarse stage gives
rejection                    "no pose" is a result
features/                    local features of a photograph
lightglue, correspond        matches among references, and of the query with them (lightglue: by a network)
retrieve, epipolar           which references resemble a photograph; whether matches fit poses
tracks                       observations of the same point; keypoints through all references
results                      what the stages give one another
scale_equations, scale       metric scale, initial pose
observations, structure      metric points
match                        which keypoints of the query show them
priors/                      what is known of the query's pose beforehand
uncertainty/                 how far a pose may be off: parts of its covariance
pnp                          the pose
resection                    pose and focal length from points that stay where they are
bundle, adjust               (ours) everything adjusted together
trust/                       whether a pose is believed
pose_covariance              the covariance of an answer's pose
answer, hints                what the method answers; what to do about a rejection
coarse/                      query and references reconstructed together, up to scale
on_device/                   scale, structure and match where a network left its output
pipeline                     a query between the parts; coarse and scale of many queries
localize                     the stages in order
groups/                      several photographs posed together
"""
