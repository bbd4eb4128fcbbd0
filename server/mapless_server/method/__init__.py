"""The method: from photographs with features to a pose, or why there is none. It knows no service, store or queue.

views, features/      photographs, and their local features
retrieve              which references resemble a photograph
correspond            matches among references, and of the query with them (lightglue: by a network)
localize              the stages in order, on one screen:
coarse/             query and references reconstructed together, up to scale
scale               metric scale, initial pose             (equations: scale_equations)
structure           metric points                          (tracks, observations)
match               which keypoints of the query show them
pnp                 the pose, and whether to believe it
adjust              (ours) everything adjusted together
on_device/            scale, structure and match where a network left its output (arrays: either library)
accuracy              what a covariance claims
"""
