"""Retrieval: choosing the references that resemble a photograph.

descriptor   the interface of global descriptors: one vector per photograph, whose dot products are similarities
vlad         the descriptor that is made of local features, and its vocabularies
megaloc      the paper's descriptor, a network on the pixels; needs torch
index        a scene's descriptors and poses, in memory or, of a large scene, in a file
index_file   the file: parts that are read when they are needed, and verified whenever they are read
index_writer writes it
lists        lists of similar rows, by which a file is searched
narrowing    limits and likely values of the camera's pose
ranking      the selection: by similarity, spread in space, within the limits; then by matches of features, of few
"""
