"""Which references resemble a photograph: global descriptors, an index of a scene, and the ranking.

descriptor   the seam: one vector a photograph, whose products are similarities
vocabulary   what VLAD is made with: the shipped ones, and one that needs no data
vlad         the descriptor that is made of the local features
index        a scene's descriptors and poses in memory
narrowing    what is known of where the camera is and looks
ranking      the order: similarity, thinned, narrowed
choice       the order by feature matches, for a few candidates
learn        how the shipped vocabularies were made; a program
"""
