"""The feed-forward 3D networks pi^3 (Wang et al. 2025) and its successor Pi3X, written from a description of them.

A network takes images of one scene and gives, up to one similarity, each view's pose and the point seen at each of its
pixels. The modules' names are those of the official checkpoints' entries. Imports only `mapless_server.extras`, and
nothing at all at import: torch takes seconds. Begin with `pi3`, then `network`.

    blocks.py      attention, normalization, rotary positions
    encoder.py     each image to patch tokens
    decoder.py     blocks within views and over the scene in turn
    heads.py       poses, points and confidence from decoded tokens
    rotation.py    the nearest rotation
    conditions.py  what Pi3X takes besides images: rays, poses
    network.py     what both have in common, in order
    pi3.py, pi3x.py
    checkpoint.py  weights from a file, all of them and nothing else
    runner.py      a network on a device

Beside them one that describes a whole image by one vector, of the same blocks:

    megaloc.py     MegaLoc (Berton and Masone 2025): DINOv2, SALAD, a linear layer
    salad.py       tokens to one vector by optimal transport

And those of local features and of their matching:

    local_features.py   ALIKED, XFeat, SuperPoint: other packages' networks, with weights of ours
    lightglue.py        LightGlue (Lindenberger et al. 2023), of kornia's layers

    weights/       which weights there are, where they lie, how they get there; without torch
"""
