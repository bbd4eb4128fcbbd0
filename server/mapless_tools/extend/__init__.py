"""`mapless-server extend`: photographs without poses are placed in a scene, with its references fixed.

Features, matches and cameras are those of `reconstruct`, the poses pycolmap's, the upload that of `ingest`. What is
decided here is the accuracy of the poses, and which of them are stored. The order of the steps is in `run`.
"""
