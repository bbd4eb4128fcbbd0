"""The feed-forward 3D networks pi^3 (Wang et al. 2025), its successor Pi3X, and MapAnything (Keetha et al. 2025).

They are our own code, written from descriptions. A network takes images of one scene and computes, up to one
similarity, each view's pose and the point seen at each of its pixels. The modules' names are those of the official
checkpoints' entries. This room imports only `mapless_server.extras`, and this file imports nothing: torch takes
seconds. Begin with `network`, then `pi3`.

    network.py     the interface of all
    blocks.py      attention, normalization, rotary positions
    encoder.py     each image to patch tokens
    checkpoint.py  weights from a file, checked to be exactly the network's
    runner.py      a network on a device

Pi3 and Pi3X:

    decoder.py     blocks within views and over the scene in turn
    heads.py       poses, points and confidence from decoded tokens; values for each pixel (DPT)
    conditions.py  the further input of Pi3X: rays, poses
    pi3.py         both

MapAnything:

    view_conditions.py  the further input: rays, depths, poses, each for any subset of the views
    mapanything.py

A network for retrieval, which computes one vector for a whole image:

    megaloc.py     MegaLoc (Berton and Masone 2025): DINOv2, SALAD (tokens to one vector), a linear layer

Networks of local features and of their matching:

    edgepoint2.py       EdgePoint2 (Yao et al. 2025), keypoints and descriptors for small devices
    local_features.py   it, and ALIKED, XFeat, SuperPoint, networks of other packages; weights loaded here
    lightglue.py        LightGlue (Lindenberger et al. 2023), of kornia's layers

    weights/       the catalogue of weights, their folder, fetching and checking; without torch
"""
