"""Which references resemble a photograph: global descriptors, an index of a scene, and the ranking.

descriptor   the seam: one vector a photograph, whose products are similarities
vocabulary   what VLAD is made with: the shipped ones, and one that needs no data
vlad         the descriptor that is made of the local features
megaloc      the paper's descriptor, a network on the pixels
index        a scene's descriptors and poses in memory
narrowing    what is known of where the camera is and looks
ranking      the order: similarity, thinned, narrowed
learn        how the shipped vocabularies were made; a program

Comparing features with a few candidates, without any of this, is `method.retrieve`.
"""
